"""Live views of a joint: history, terminal and web page. They read what is on zenoh and change nothing."""
