"""Control of a robot's joints at 1 kHz: limits, reference motion, torque and clearance, without JAX.

The functions are elementwise and take NumPy arrays, JAX arrays, or the scalars of a kernel: the environments train with
the code that `mimic.deploy` runs on a robot.
"""
