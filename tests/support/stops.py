"""Work that is cancelled on its way."""

from langsplat_core.progress import Cancelled, Progress, Report


def stop_at(stage: str, fraction: float = 0.0) -> Progress:
    """Progress that cancels the work where a stage, named by how it begins, has come so far."""

    def show(at: Report) -> None:
        if at.stage.startswith(stage) and at.fraction >= fraction:
            raise Cancelled

    return Progress(show)
