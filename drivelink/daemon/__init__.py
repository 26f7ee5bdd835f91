"""The daemon: buses joined, joints served, faults watched, joint files reloaded, status told."""
