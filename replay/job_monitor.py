"""What a job on a log reports to while it runs, and who may end it early."""


class JobMonitor:
    """This one shows nothing and never stops a job; the command line's draws a bar and listens to signals."""

    @property
    def stopped_by(self) -> str:
        """The signal that asks for an early end; empty = none has come. Looked at before every frame."""
        return ""

    def start(self, total: int | None, stage: str = "") -> None:
        """A stage of so many units of work begins; None where nobody knows how many. ``stage`` names it where its units
        are not those of the job."""

    def set(self, done: int, note: str = "") -> None:
        """So many units are done; ``note`` says what is being done."""
