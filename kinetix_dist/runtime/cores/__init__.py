"""Cores of the processes of a run: the computation of each role, with what it needs.

Called by `runtime/driver/` through handles, and built inside processes by `build.py`. Nothing here knows of Ray, of
processes or of run directories, so that local mode, one worker and many are the same code.

"""
