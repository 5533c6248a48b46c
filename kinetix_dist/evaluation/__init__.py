"""Evaluation: solve rates of a policy on a set of levels, with intervals, next to baselines that learned nothing."""
