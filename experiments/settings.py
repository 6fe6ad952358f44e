"""What every kind of experiment can be told, and what its settings are made of; imports nothing heavy."""

from collections import Counter
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, ValidationInfo, field_validator, model_validator

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Finite = Annotated[float, Field(allow_inf_nan=False)]
Confidence = Annotated[float, Field(gt=0.5, lt=1.0)]
Several = Annotated[int, Field(ge=2)]
Precision = Literal["float32", "float64"]


class SettingsTable(BaseModel):
    """A table of settings that refuses unknown keys and wrong types."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)

    @field_validator("*")
    @classmethod
    def _fits(cls, value: Any, info: ValidationInfo) -> Any:
        """Refuse counts beyond the integers that index arrays, where a seed has a bound of its own, and lists with one twice."""
        for one in value if isinstance(value, tuple) else (value,):
            if isinstance(one, int) and abs(one) >= 2**31 and info.field_name != "seed":
                raise ValueError(f"must be below 2^31, got {one:.3g}")
        # Twice the same would count as two in tests and answers over all of them; a point may have a coordinate twice.
        if value and isinstance(value, tuple) and "..." in str(cls.model_fields[str(info.field_name)].annotation):
            # Methods are told apart by their labels.
            one, count = Counter(getattr(one, "label", one) for one in value).most_common(1)[0]
            if count > 1:
                raise ValueError(f"must differ, got {f'{one:g}' if isinstance(one, float) else one} more than once")
        return value


class RunSettings(SettingsTable):
    """What every kind of experiment has."""

    experiment: str  # the kind of experiment, a folder or a file of `experiments`
    seed: Annotated[int, Field(ge=0, lt=2**32)] = 0  # of every random number in the run
    precision: Precision = "float64"  # of every array in the run


class SizedSettings(RunSettings):
    """What a kind has that takes its `sizes` from the file's table `[sizes.*]` that the size names."""

    size: Literal["quick", "default", "full"] = "default"  # how much is spent


class VideoSettings(SettingsTable):
    """How a video is drawn."""

    speed: Positive = 0.25  # simulated over shown time: 1 is real speed
    fps: Positive = 30.0  # frames per second
    width: Annotated[int, Field(ge=64, le=1920)] = 480  # of one motion, in pixels
    height: Annotated[int, Field(ge=64, le=1080)] = 270  # of one motion, in pixels


class OwnScene(SettingsTable):
    """A scene of one's own, in place of those that a kind of experiment has."""

    scene: str | None = None  # an MJCF file; without it, the experiment's own
    # Of a trajectory: file.py:function, module:function, or at the end height:body, speed:body, upright:body,
    # reach:body/site; without it, a random mix of where the heaviest body ends up.
    cost: str | None = None
    start: str | None = None  # a key frame of the scene by name; without it, the reference pose
    # Time steps of a rollout; without it, those of half a second, 50 to 300.
    horizon: Annotated[int, Field(ge=1, le=100_000)] | None = None

    @model_validator(mode="after")
    def _is_whole(self) -> Self:
        if self.scene is None and (given := self.model_fields_set & {"cost", "start", "horizon"}):
            raise ValueError(f"{', '.join(sorted(given))}: of a scene of one's own; give scene its file, too")
        if self.scene is not None and not Path(self.scene).is_file():
            raise ValueError(f"scene: there is no file {self.scene!r}")
        return self
