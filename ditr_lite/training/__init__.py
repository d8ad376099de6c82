"""Training: batches of frames, one recipe a part, the loop that a stopped run goes on with."""
