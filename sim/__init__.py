"""A simulated world: joints with switchable physical effects, and the devices that put them on a CAN bus.

Independent of service and estimator: the physics is written here a second time on purpose.
"""
