"""The thesis' two benchmark plants and experiments on them. Their signals have no unit."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import cont2discrete

from mimopilot.tuning.design.refine_on_model import model_reference_cost
from mimopilot.tuning.loop_controller import LoopController, closed_loop
from mimopilot.tuning.reference_matrix import Wanted
from mimopilot.tuning.reference_model import ReferenceModel
from mimopilot.tuning.statespace import StateSpace

TABLES = Path(__file__).with_name("thesis_tables.json")
#: Number of frequencies for J_MR, (3.1) of the thesis.
GRID = 4000

Signal = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Benchmark:
    """A known 2x2 plant and its tuning task.

    Attributes
    ----------
    plant : StateSpace
        The true plant; no tuning method uses it.
    model : ReferenceModel
        Desired complementary sensitivity of both outputs.
    initial : LoopController or None
        Controller during experiments; None: open loop.
    deviation : float
        Standard deviation of the white measurement noise.
    printed : dict
        This plant's part of the thesis' tables.
    """

    plant: StateSpace
    model: ReferenceModel
    initial: LoopController | None
    deviation: float
    printed: dict[str, Any]

    @property
    def models(self) -> list[ReferenceModel]:
        """The reference model of each output."""
        return [self.model] * 2

    def cost(
        self, controller: LoopController, models: Wanted | None = None, emphasis: ReferenceModel | None = None
    ) -> float:
        """J_MR, (3.1) of the thesis, on the true plant; infinite when the loop is not stable.

        Parameters
        ----------
        controller : LoopController
        models : sequence of ReferenceModel, or ReferenceMatrix, optional
            M; that of the thesis by default.
        emphasis : ReferenceModel, optional
            W(z); 1 by default, as in the thesis' benchmarks.
        """
        if not closed_loop(self.plant, controller).stable:
            return float("inf")
        return model_reference_cost(self.plant, controller, models or self.models, GRID, emphasis)

    def run(
        self,
        controller: LoopController | None,
        r: Signal,
        u_bar: Signal,
        generator: np.random.Generator,
    ) -> tuple[Signal, Signal]:
        """Run one experiment, or several at once, from rest.

        Parameters
        ----------
        controller : LoopController or None
            Controller in the loop; None: open loop, r has no effect.
        r, u_bar : (N, 2) or (N, runs, 2) arrays
            Setpoint, and excitation added at the plant input.
        generator : numpy.random.Generator
            For the measurement noise.

        Returns
        -------
        u, y : arrays of the shape of `u_bar`
            Plant input and measured output.
        """
        noise = self.deviation * generator.standard_normal(u_bar.shape)
        if controller is None:
            return u_bar, self.plant.simulate(u_bar) + noise
        signals = closed_loop(self.plant, controller).simulate(np.concatenate([r, u_bar, noise], axis=-1))
        return signals[..., :2], signals[..., 2:]


def excitation(samples: int, design: str, generator: np.random.Generator, amplitude: float = 1.0) -> Signal:
    """Binary excitation of two inputs with a new random value every sample: white up to the Nyquist frequency.

    Parameters
    ----------
    samples : int
    design : str
        ``in turn``: one axis in each half, as in the thesis. ``together``: both axes all the time.
    generator : numpy.random.Generator
    amplitude : float

    Returns
    -------
    (samples, 2) array
    """
    signal = amplitude * generator.choice([-1.0, 1.0], (samples, 2))
    if design == "in turn":
        half = samples // 2
        signal[:half, 1] = 0.0
        signal[half:, 0] = 0.0
    return signal


def numerical_example() -> Benchmark:
    """G = [[0.09516, 0.03807], [-0.02974, 0.04758]]/(z - 0.9048), noise-free, open loop."""
    printed = json.loads(TABLES.read_text())["numerical_example"]
    gain, pole = np.array(printed["G_num"]), -printed["G_den"][1]
    plant = StateSpace(pole * np.eye(2), gain, np.eye(2), np.zeros((2, 2)), printed["Ts"])
    return Benchmark(plant, _model(printed, plant.Ts), None, 0.0, printed)


def lv100() -> Benchmark:
    """The LV100 gas turbine by Tustin's rule (D is not zero), under the controller that stabilises it."""
    printed = json.loads(TABLES.read_text())["lv100"]
    Ts = printed["Ts"]
    continuous = tuple(np.array(printed[name], float) for name in "ABCD")
    A, B, C, D, _ = cont2discrete(continuous, Ts, method=printed["discretisation"])
    plant = StateSpace(A, B, C, D, Ts)
    initial = LoopController.from_polynomial(**printed["C0_stabilising"], Ts=Ts)
    return Benchmark(plant, _model(printed, Ts), initial, float(np.sqrt(printed["noise_variance"])), printed)


def _model(printed: dict[str, Any], Ts: float) -> ReferenceModel:
    num, den = (tuple(float(v) for v in printed["reference_model"][key]) for key in ("num", "den"))
    return ReferenceModel(num, den, 0, Ts, label=f"{num[0]:g}/(z - {-den[1]:g})")
