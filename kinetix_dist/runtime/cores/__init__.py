"""What a process of a run computes: cores, what holds them, evaluation, levels, the compile cache.

Called by `runtime/driver/` through handles, and built inside processes by `build.py`. Nothing here knows of Ray, of
processes or of run directories, so that local mode, one worker and many are the same code. Commands use
`compile_cache` alone.
"""
