"""The kinds of experiment there are."""

import importlib
from collections.abc import Callable
from dataclasses import dataclass

from experiments.ablation.settings import AblationSettings
from experiments.artificial_discontinuity.settings import ArtificialDiscontinuitySettings
from experiments.bias_variance.settings import BiasVarianceSettings
from experiments.billiards.settings import BilliardsSettings
from experiments.bounce.settings import BounceSettings
from experiments.config import RunSettings
from experiments.cube_toss.settings import CubeTossSettings
from experiments.kernels.settings import KernelsSettings
from experiments.long_horizon.settings import LongHorizonSettings
from experiments.optimisation.settings import OptimisationSettings
from experiments.planning.settings import PlanningSettings
from experiments.policy_gradient.settings import PolicyGradientSettings
from experiments.report import Report
from experiments.rolling_pin.settings import RollingPinSettings
from experiments.sawtooth.settings import SawtoothSettings
from experiments.stability.settings import StabilitySettings
from experiments.textbook.settings import TextbookSettings
from experiments.work_precision.settings import WorkPrecisionSettings
from experiments.workspace import Workspace


@dataclass(frozen=True)
class Experiment:
    """A kind of experiment.

    Attributes:
        settings: its configuration.
        function: `module:name` of `(settings, workspace) -> Report`. A name, so that a configuration is checked,
            and precision and OpenGL are chosen, before JAX and MuJoCo are imported.
    """

    settings: type[RunSettings]
    function: str

    def load(self) -> Callable[[RunSettings, Workspace], Report]:
        """Import the function that runs it."""
        module, _, name = self.function.partition(":")
        return getattr(importlib.import_module(module), name)


EXPERIMENTS = {
    "ablation": Experiment(AblationSettings, "experiments.ablation.run:run"),
    "artificial_discontinuity": Experiment(
        ArtificialDiscontinuitySettings, "experiments.artificial_discontinuity.run:run"
    ),
    "billiards": Experiment(BilliardsSettings, "experiments.billiards.run:run"),
    "cube_toss": Experiment(CubeTossSettings, "experiments.cube_toss.run:run"),
    "optimisation": Experiment(OptimisationSettings, "experiments.optimisation.run:run"),
    "bias_variance": Experiment(BiasVarianceSettings, "experiments.bias_variance.run:run"),
    "bounce": Experiment(BounceSettings, "experiments.bounce.run:run"),
    "kernels": Experiment(KernelsSettings, "experiments.kernels.run:run"),
    "long_horizon": Experiment(LongHorizonSettings, "experiments.long_horizon.run:run"),
    "planning": Experiment(PlanningSettings, "experiments.planning.run:run"),
    "policy_gradient": Experiment(PolicyGradientSettings, "experiments.policy_gradient.run:run"),
    "rolling_pin": Experiment(RollingPinSettings, "experiments.rolling_pin.run:run"),
    "sawtooth": Experiment(SawtoothSettings, "experiments.sawtooth.run:run"),
    "stability": Experiment(StabilitySettings, "experiments.stability.run:run"),
    "textbook": Experiment(TextbookSettings, "experiments.textbook.run:run"),
    "work_precision": Experiment(WorkPrecisionSettings, "experiments.work_precision.run:run"),
}
