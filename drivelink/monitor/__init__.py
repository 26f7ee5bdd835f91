"""Live views of a joint in terminal and browser; read-only."""
