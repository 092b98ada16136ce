"""What pictures of a run say of it, and what is said of a run that has no such picture."""

from __future__ import annotations

from labseq.config.wording import clean
from labseq.errors import ConfigError, Problem
from labseq.recording import Run


def note_of(run: Run) -> str:
    """The line below a picture's title: which run, how it ended, and of what kind it is."""
    ended = "" if run.status == "complete" else f" ({run.status}, {len(run.shots)} of {run.n_shots} shots)"
    atoms = f"{clean(run.target.name)}, {run.target.n_atoms} atoms"
    kind = "simulated" if run.simulated else "measured"
    return f"{clean(run.path.parent.name)}/{clean(run.path.name)}{ended}: {atoms}, seed {run.seed}, {kind}"


def unfit(run: Run, what: str, expected: str, picture: str = "figure") -> ConfigError:
    """An error that says why a picture cannot be drawn from a run.

    Args:
        run: The run.
        what: What is in the way.
        expected: What the picture needs.
        picture: What it is called.
    """
    text = f"the {picture} cannot be drawn from this run: {what}"
    return ConfigError(Problem(text, clean(str(run.path)), expected=expected))
