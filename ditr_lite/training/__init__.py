"""Training: one loop for every network, in one process or many, and what is around it.

loop              the loop; recipes, shares of a batch, on what it runs
checkpoints       what a stopped run goes on from
scenes readers    rendered scenes, and frames of real datasets, to draw from
views batches     what a step sees
recipes losses    what a step of each part draws and is scored by
parts             one part from start to weights and card
adapt             fine-tuning to another camera or place
as_the_paper finetune   the paper's own recipes
boundary          the learned boundary backend
kept_maps logs    boundary maps by content; curves as CSV and for TensorBoard
"""
