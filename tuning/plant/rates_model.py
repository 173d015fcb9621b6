"""State-space model from torque to body rates: PBSID with the order that fits the measured frequency response."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mimopilot.tuning.errors import TuningError
from mimopilot.tuning.experiment import Experiment
from mimopilot.tuning.plant.frequency_response import PlantResponse
from mimopilot.tuning.plant.pbsid import PAST, IdentifiedModel, pbsid, state_sequence
from mimopilot.tuning.statespace import Response, Signal, StateSpace

#: Largest order compared with a measured response: body, rotors, a filter and delays on two axes.
RESPONSE_ORDER = 12
#: The lowest order is taken whose weighted square error is within this factor of the least.
NEARLY = 1.3
#: Percent. A model with a lower fit to the response is useless.
POOR = 50.0
#: Relative error of a response besides its noise.
SHAPE = 0.01
#: Relative error at which a frequency has half weight in a fit.
SURE = 0.05


@dataclass(frozen=True, eq=False)
class RatesModel:
    """A model from torque to body rates, and its fit.

    Attributes
    ----------
    model : IdentifiedModel
    one_step_percent : (2,) array
        Fit of the prediction one sample ahead, roll and pitch rate.
    response_percent : float
        Fit of its frequency response to the measured one, see `response_fit`.
    """

    model: IdentifiedModel
    one_step_percent: Signal
    response_percent: float


def identify_rates(
    experiment: Experiment,
    plant: PlantResponse,
    *,
    order: int | None = None,
    past: int = PAST,
    future: int | None = None,
) -> RatesModel:
    """Identify the plant from torque to body rates; see `pbsid`.

    Parameters
    ----------
    experiment : Experiment
    plant : PlantResponse
        Its measured response; by default the order is chosen to fit it.
    order, past, future
        See `pbsid`.

    Raises
    ------
    TuningError
        As `pbsid_by_response`; or when the predictor of the given order is not stable.
    """
    u, y, segments = experiment.u, experiment.y_i, experiment.segments
    known = plant.at(plant.known_run())
    if not len(known.omega):
        raise TuningError(
            f"{experiment.source}: not excited: the rate response is known at no frequency; excite both axes"
        )
    if order is None:
        model, response = pbsid_by_response(
            u, y, experiment.Ts, known.omega, known.G_i, known.deviation(), past=past, future=future, segments=segments
        )
    else:
        model = pbsid(u, y, experiment.Ts, order=order, past=past, future=future, segments=segments)
        if not model.predictor_stable:
            raise TuningError(
                f"identification: the predictor of order {order} is not stable; give another order, or none"
            )
        response = response_fit(model.plant, known.omega, known.G_i, known.deviation())
    u, y = u - u.mean(axis=0), y - y.mean(axis=0)
    parts = [(y[a:b][past:], model.predict(u[a:b], y[a:b])[past:]) for a, b in segments]
    measured, predicted = (np.vstack(side) for side in zip(*parts, strict=True))
    return RatesModel(model, fit(measured, predicted), response)


def pbsid_by_response(
    u: Signal,
    y: Signal,
    Ts: float,
    omega: Signal,
    response: Response,
    deviation: Signal,
    *,
    past: int = PAST,
    future: int | None = None,
    segments: Sequence[tuple[int, int]] | None = None,
    least_fit: float = POOR,
) -> tuple[IdentifiedModel, float]:
    """`pbsid` with the order whose frequency response is nearest to the measured one.

    In closed loop the drop of the singular values is a poor guide: on PX4 logs it chose order 2, whose predictor
    diverged, while orders 4 to 8 fitted.

    Parameters
    ----------
    omega : (K,) array, rad/s
    response : (K, n_y, n_u) array
        Measured response from u to y.
    deviation : (K, n_y, n_u) array
        Its standard deviation.
    u, y, Ts, past, future, segments
        See `pbsid`.
    least_fit : float, percent
        Least acceptable fit.

    Returns
    -------
    model : IdentifiedModel
        The model of lowest order with a stable predictor whose error is within `NEARLY` of the least.
    fit : float, percent
        See `response_fit`.

    Raises
    ------
    TuningError
        As `pbsid`; or when no order has a stable predictor or fits.
    """
    states = state_sequence(u, y, Ts, past, future, None, segments)
    size = np.linalg.norm(response, axis=(1, 2))[:, None, None]
    weight = 1 / (deviation**2 + (SHAPE * size) ** 2)
    found = []
    for order in range(1, min(RESPONSE_ORDER, states.most, len(states.singular_values)) + 1):
        model = states.model(order)
        if model.predictor_stable:
            error = float(np.sum(weight * np.abs(model.plant.frequency_response(omega) - response) ** 2))
            found.append((error, model))
    if not found:
        raise TuningError("identification: no order has a stable predictor; record longer, or excite more strongly")
    least = min(error for error, _ in found)
    model = next(model for error, model in found if error <= NEARLY * least)
    fit = response_fit(model.plant, omega, response, deviation)
    if fit < least_fit:
        raise TuningError(
            f"identification: no model of order 1 to {RESPONSE_ORDER} fits the measured response (best fit "
            f"{fit:.0f} %, expected {least_fit:g} % or more); record longer, or excite more strongly"
        )
    return model, fit


def response_fit(plant: StateSpace, omega: Signal, response: Response, deviation: Signal) -> float:
    """Fit of a plant to a measured response: 100 (1 - |G - model| / |G|), percent.

    Each frequency is weighted by itself, so that all octaves of an integrator count, and by its certainty.

    Parameters
    ----------
    plant : StateSpace
    omega : (K,) array, rad/s
    response, deviation : (K, n_y, n_u) arrays
        Measured response and its standard deviation.
    """
    size, spread = (np.linalg.norm(part, axis=(1, 2)) for part in (response, deviation))
    weight = (omega / (1 + (spread / (SURE * size)) ** 2))[:, None, None]
    off = np.linalg.norm(weight * (plant.frequency_response(omega) - response))
    return 100 * (1 - float(off / np.linalg.norm(weight * response)))


def fit(measured: Signal, modelled: Signal) -> Signal:
    """Normalised root-mean-square fit of each column, percent; 100 is perfect, 0 no better than the mean."""
    error = np.sqrt(np.mean((measured - modelled) ** 2, axis=0))
    figure: Signal = 100 * (1 - error / np.std(measured, axis=0))
    return figure


def model_toml(model: IdentifiedModel, log_sha256: str) -> str:
    """The model as TOML text: Ts (s), A, B, C, D, K, windows, and the hash of the log."""
    rows = {name: getattr(model.plant, name).tolist() for name in "ABCD"} | {"K": model.K.tolist()}
    lines = [
        "# x(k+1) = A x + B u + K e, y = C x + D u + e; u torque (normalised), y body rates in rad/s",
        "version = 1",
        f"Ts = {model.plant.Ts!r}",
        f"past = {model.past}",
        f"future = {model.future}",
        f'log_sha256 = "{log_sha256}"',
    ]
    for name, matrix in rows.items():
        lines += [f"{name} = [", *(f"  {row}," for row in matrix), "]"]
    return "\n".join(lines) + "\n"
