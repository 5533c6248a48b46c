"""The reference backend in plain JAX: any device, float32 or float64, differentiable; the oracle of the kernel.

Files and functions are named as those of `warp/native`; each steps one world, and `backend.py` maps it over a batch.
Where the kernel uses a series for a small angle, the reference uses sine and cosine.
"""
