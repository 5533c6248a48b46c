"""The pages: dashboards of runs, and the editor and player of levels.

browser --HTTP, websocket--> server --(threads)--> runs: readers of run directories
        <-- static: HTML, ES modules     |--(pipe)--> worker: a process with jax that draws, checks and plays levels
"""
