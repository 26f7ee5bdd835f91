"""A controller of a variable-stiffness joint that lives on drivelink's estimates."""
