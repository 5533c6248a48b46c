"""Sinks of metrics, evaluations, events and rollouts; those of `run.sinks` by name."""

from kinetix_dist.telemetry.sinks.sink import RANDOM_POLICY, SINKS, Evaluation, Sink, SinkRun, evaluation_rates
from kinetix_dist.telemetry.sinks.tensorboard import TensorboardSink

__all__ = ["RANDOM_POLICY", "SINKS", "Evaluation", "Sink", "SinkRun", "TensorboardSink", "evaluation_rates"]
