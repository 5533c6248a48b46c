"""Running a training run: three rooms.

    driver      what drives a run: the loop, placements, checkpoints, reports    imports the other two
    processes   how processes are started, given memory, watched and ended       imports neither
    cores       what a process computes; plain JAX, called alike with and without Ray   imports neither

The commands (`kinetix_dist/cli/`) may call all three; nothing else outside may.
"""
