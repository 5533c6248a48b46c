"""Data sets of transitions: written by `kinetix-dist collect`, read by `open_dataset`.

    dataset.json          what they are of: format, environment, observation, actions, level set, policy, seed
    levels.npz            each level once: its arrays, its static observation, which shapes are the robot
    shards.jsonl          a line for each shard that is whole: rows, bytes, SHA-256
    shard-000000.parquet  transitions, sorted by episode and step

docs/data.md is about the commands and the format.
"""

from kinetix_dist.data.dataset import Dataset, Transitions, open_dataset
from kinetix_dist.data.manifest import DatasetError

__all__ = ["Dataset", "DatasetError", "Transitions", "open_dataset"]
