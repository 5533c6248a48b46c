"""Events that a run can write to events.jsonl, and their meanings. A name that is not here is refused."""

from __future__ import annotations


class UnknownEventError(ValueError):
    """An event was reported that `EVENTS` does not describe."""


EVENTS: dict[str, str] = {
    # Processes
    "process_started": "a process began: who, where, with how much memory, which packages it imports from where",
    "process_lost": "a process died, fell silent or exceeded a time limit: which, and in which section of the run",
    "recovered": "the first new result after a loss: from and to which update, seconds since that loss",
    "resized": "nodes were lost or came: from and to how many processes of a role, and at which update",
    "straggler": "a rollout actor took over twice the median of the others, five batches in a row: which, and seconds",
    "fork_server_lost": "the fork server ended or was stopped, and another one replaces it: why",
    "token_secured": "Ray's token file could be read by others, and cannot any more",
    "run_started": "the command began: its process, the number of this session, and whether it goes on with a run",
    "run_finished": "the run came to its end: after which update",
    "stopped": "SIGTERM or Ctrl-C ended the run: after which update, and whether that is saved",
    "run_failed": "the run ended by an error: which",
    # Evaluation
    "evaluated": "an evaluation during training is there: of which update, its solve rates, and the seconds it took",
    "recorded": "rollouts were recorded: of which update, how many, and into which file",
    "evaluation_left_out": "an evaluation or a recording was due while four waited for the evaluator",
    # Imitation
    "imitated": "imitation ended, before the first update: gradient steps, seconds, loss, the curve on levels held out",
    # Phases
    "phase_began": "a phase of `phases` began: its number, at which update and environment step, and what it changes",
    # Curriculum
    "buffer_adopted": "a refresh of the curriculum is used from an update on",
    "buffer_late": "the curator was lost or silent when a refresh was due: the old buffer stays in use until it comes",
    "refresh_lost": "a refresh was given up, since the next one is due; the buffer before it stays in use",
    # Checkpoints
    "resumed": "training goes on from a checkpoint; `differs` lists other devices and versions than made it",
    "checkpoint_saved": "a checkpoint was written and verified: of which update, and the seconds that took",
    "checkpoint_failed": "a checkpoint could not be saved: why; older ones stay",
    "checkpoint_rejected": "a checkpoint cannot be used: why",
    "drafts_removed": "unfinished checkpoints of processes that are gone were removed",
    # Files
    "lines_set_aside": "damaged lines were moved into the `.damaged` file of the same name",
    "file_set_aside": "a file that cannot be read was renamed: to what, and why",
    "sink_failing": "rows of metrics begin to be dropped: by which sink, and why",
    "sink_recovered": "a sink takes rows again: how many were dropped in between",
    "events_dropped": "events that could not be written and were too many to keep in memory: how many",
    "file_failed": "a file of the run could not be written: why; training goes on",
    "recording_dropped": "rollouts were not recorded, since the disk is slower than they come",
    "recording_failed": "a recording could not be written: why",
    "pictures_failed": "pictures of the last recording could not be drawn after training: why",
    # Numbers
    "steps_skipped": "some gradient steps of an update were skipped as not finite, for the first time in the session",
    "update_skipped": "no gradient step of an update was finite: nothing was learned in it",
    "rolled_back": "too many updates were skipped in a row: training goes on from the last checkpoint",
    "physics_warning": "a counter of the physics that should be zero is not, for the first time",
}


def check_event(name: str) -> str:
    """The name; raises UnknownEventError for one that is not described."""
    if name not in EVENTS:
        raise UnknownEventError(f"event {name!r} is not described; add it to kinetix_dist/telemetry/event_names.py")
    return name
