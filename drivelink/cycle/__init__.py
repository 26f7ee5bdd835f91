"""The cycle: frames in, one sample per SYNC, estimate, out; in one thread, paced by a clock or by none."""
