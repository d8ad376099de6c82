"""What the notebooks' exercises are checked with: an attempt is told what is wrong with it, not only that it is."""
