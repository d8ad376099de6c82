"""Rendered scenes and simulated depth cameras: frames whose truth is known, and why each pixel was lost."""
