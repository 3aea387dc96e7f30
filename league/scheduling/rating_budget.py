"""The device time of rating matches while players learn: the setting `rating.share`, enforced by booking batches.

Every batch is booked to a second of the league's training. After a batch that took s seconds of a device, the next one
is due s / share seconds of training later. Matches therefore take that share of training time in total, for any
duration of a batch. The account consists of two numbers of the match log, the newest booking and the seconds of its
batches, so it survives a kill and hours of rating after training.
"""

from league.state.league_state import Batches

CREDIT = 60.0  # seconds of training for which unused time is kept; older time is forfeited


def next_slot(share: float, trained: float, last: Batches | None) -> float | None:
    """Return the second of training to which batches queued now are booked; None if none may be queued yet.

    Args:
        share: the setting `rating.share`.
        trained: seconds of training that the league has had.
        last: the newest batches.
    """
    if share == 0.0:
        return None
    due = 0.0
    if last is not None and last.due <= trained:  # otherwise the schedule, which defines training time, has changed
        due = last.due + last.seconds / share
    if due > trained and share < 1.0:
        return None
    return min(max(due, trained - CREDIT), trained)
