"""Scores and costs: every method on many frames, with intervals; what each stage takes in time and memory."""
