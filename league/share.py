"""How much of the devices rating matches take while players learn: the setting `rating.share`, kept by booking.

Every batch is booked to a second of the training that the league has had, and pays for what it took: where it took s
seconds of a device, the next one is due s / share seconds of training later. So what matches took in all is that share
of training, whatever a batch takes, and a league that is killed, or rated for hours after its training, goes on with
the same account: it is the newest booking and what it took, two numbers of the match log.
"""

from league.standing import Batches

CREDIT = 60.0  # seconds of training for which time that nobody used is kept; older time is forgotten


def booking(share: float, trained: float, last: Batches | None) -> float | None:
    """The second of training to which batches are booked that are queued now; None where none may be queued yet.

    Args:
        share: the setting `rating.share`.
        trained: seconds of training that the league has had.
        last: the batches that were queued last.
    """
    if share == 0.0:
        return None
    due = 0.0
    if last is not None and last.due <= trained:  # else the schedule has changed, by which training is counted
        due = last.due + last.seconds / share
    if due > trained and share < 1.0:
        return None
    return min(max(due, trained - CREDIT), trained)


def words(share: float, trained: float, rated: float) -> str:
    """The share that was asked for beside the true one of `rated` device seconds, e.g. for `league status`."""
    asked = "as much as they get" if share == 1.0 else f"{100 * share:.3g} %"
    if not trained:
        return f"nobody has learnt yet (rating.share: {asked})"
    return f"{100 * rated / trained:.3g} % of the time of the devices that train (rating.share: {asked})"
