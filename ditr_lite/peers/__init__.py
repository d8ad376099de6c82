"""Small stand-ins for one idea of each system that the paper compares with."""
