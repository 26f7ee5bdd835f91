"""The daemon: joins buses, serves joints, monitors faults, reloads joint files, reports status."""
