"""A simulated world: joints with switchable physical effects, and the devices that put them on a CAN bus.

Knows nothing of the service or of the estimator: what the estimator believes and what the world does
are written twice on purpose.
"""
