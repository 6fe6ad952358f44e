"""What a run tells its user when it cannot go on."""

import difflib
from collections.abc import Iterable


class ExperimentError(Exception):
    """A run that cannot go on, for a reason that one sentence explains: shown without a traceback."""


class ConfigurationError(ExperimentError):
    """Mistakes in a configuration, all of them at once: one sentence each, opened by the dotted path of its setting."""

    def __init__(self, source: str, mistakes: Iterable[str]):
        self.source = source
        self.mistakes = tuple(dict.fromkeys(mistakes))
        count = "a mistake" if len(self.mistakes) == 1 else f"{len(self.mistakes)} mistakes"
        super().__init__("\n  ".join([f"{source} has {count}:", *self.mistakes]))


def suggest(given: str, choices: Iterable[str]) -> str:
    """Answer a wrong choice with the nearest one, or with all: the end of a sentence, such as `did you mean "seed"?`."""
    choices = list(choices)
    near = difflib.get_close_matches(given, choices, n=1, cutoff=0.6)
    return f'did you mean "{near[0]}"?' if near else f"choose one of {', '.join(sorted(choices))}"
