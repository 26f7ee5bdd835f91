"""The demo: a simulated joint and its daemon in one process, a subscriber in another."""
