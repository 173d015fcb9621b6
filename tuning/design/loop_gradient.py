"""The closed loop around a plant and its exact derivatives with respect to the gains.

u = C_ref r_o - C_o y_o - C_y y_i, with C_ref = C_r (Kp_o m + Kff_o m_w) + Kaff_i m_a: m, m_w and m_a are the attitude
model's angle, rate and acceleration, or 1, 0 and 0 without one. ArduPilot's law adds C_r times the setpoint's rate.
Each gain adds the product of a column and a row to the controller, dL = alpha beta', dC_ref = alpha gamma' and
dC_o = alpha delta', so all derivatives are such products:

    S = (I + L)^-1,  L = C_y G_i + C_o G_o        dS = -(S alpha) (beta' S)
    U = S C_ref,     T = G_o U                    dU = (S alpha) (gamma' - beta' U)
    T_y = G_o S C_o                               dT_y = (G_o S alpha) (delta' - beta' S C_o)
    u_n = S (C_y N_i + C_o N_o)                   du_n = (S alpha) (xi' - beta' u_n)
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from mimopilot.tuning.design.free_gains import ACCELERATION, FreeGains
from mimopilot.tuning.law import (
    attitude_response,
    fixed_matrices,
    model_response,
    rate_response,
    setpoint_rate_response,
)
from mimopilot.tuning.law_terms import ATTITUDE, ATTITUDE_FEEDFORWARD, LOOP_TERMS
from mimopilot.tuning.plant.wide_response import WideResponse
from mimopilot.tuning.small_matrices import inverse

Complex = NDArray[np.complex128]
Signal = NDArray[np.float64]

#: Matrix -> letter of its term of the rate loop.
LETTERS = {term.matrix: letter for letter, term in LOOP_TERMS.items()}


@dataclass(frozen=True, eq=False)
class ProductGradient:
    """Derivatives of a matrix with respect to n gains, each a column times a row: left (K, n, i), right (K, n, j)."""

    left: Complex
    right: Complex

    def times(self, matrix: Complex) -> ProductGradient:
        """Derivative of the matrix (K, j, m) multiplied from the right by a constant one."""
        return ProductGradient(self.left, self.right @ matrix)

    def after(self, matrix: Complex) -> ProductGradient:
        """Derivative of the matrix multiplied from the left by a constant one (K, m, i)."""
        return ProductGradient(self.left @ matrix.transpose(0, 2, 1), self.right)

    def whole(self) -> Complex:
        """All derivatives, (n, K, i, j)."""
        product: Complex = (self.left[:, :, :, None] * self.right[:, :, None, :]).transpose(1, 0, 2, 3)
        return product


@dataclass(frozen=True, eq=False)
class LoopGradient:
    """The closed loop of a gain vector and its derivatives with respect to the vector's elements.

    Attributes
    ----------
    plant : WideResponse
    free : FreeGains
    vector : (n,) array
    """

    plant: WideResponse
    free: FreeGains
    vector: Signal

    @cached_property
    def matrices(self) -> Mapping[str, Signal]:
        """Name -> free matrix."""
        gains = self.free.gains(self.vector)
        return {name: getattr(gains, name) for name in self.free.units}

    @cached_property
    def _shapes(self) -> Mapping[str, tuple[Complex, Complex]]:
        """Rate controller's matrix -> responses (K, 1, n) of its columns from the rate setpoint and rate to u."""
        one, shape = np.ones((1, self.plant.axes)), (len(self.plant.omega), 1, self.plant.axes)
        found = {
            name: rate_response({LETTERS[name]: one}, self.free.base.filters, self.plant.omega)
            for name in self.free.units
            if name in LETTERS
        }
        return {name: (np.broadcast_to(r, shape), np.broadcast_to(y, shape)) for name, (r, y) in found.items()}

    @cached_property
    def C_r(self) -> Complex:  # noqa: N802
        """From the rate setpoint to u, (K, n, n)."""
        tuned = np.asarray(sum(of_r * self.matrices[name] for name, (of_r, _) in self._shapes.items()), complex)
        fixed = fixed_matrices(self.free.base.filters, self.plant.axes)
        return tuned + rate_response(fixed, self.free.base.filters, self.plant.omega)[0] if fixed else tuned

    @cached_property
    def C_y(self) -> Complex:  # noqa: N802
        """From the measured rates to -u, (K, n, n)."""
        return np.asarray(sum(of_y * self.matrices[name] for name, (_, of_y) in self._shapes.items()), complex)

    @cached_property
    def C_o(self) -> Complex:  # noqa: N802
        """From the measured angles to -u, (K, n, n)."""
        return self.C_r @ self.matrices[ATTITUDE.matrix] * self._delay

    @cached_property
    def _delay(self) -> Complex:
        """From the attitude controller's output to the rate controller, (K, 1, 1)."""
        return attitude_response(self.free.base.filters, self.plant.omega)

    @cached_property
    def L_i(self) -> Complex:  # noqa: N802
        """The rate loop cut at u, (K, n, n)."""
        return self.C_y @ self.plant.G_i

    @cached_property
    def L_u(self) -> Complex:  # noqa: N802
        """The whole loop cut at u, (K, n, n)."""
        return self.L_i + self.C_o @ self.plant.G_o

    @cached_property
    def S(self) -> Complex:  # noqa: N802
        """Sensitivity at u, (K, n, n)."""
        return inverse(np.eye(self.plant.axes) + self.L_u)

    @cached_property
    def _model(self) -> tuple[Complex, Complex, Complex]:
        """Angle, rate and acceleration of the attitude model, (K, 1, 1) each."""
        return model_response(self.free.base.filters, self.plant.omega)

    @cached_property
    def _rate_setpoint(self) -> Complex:
        """From the attitude setpoint to the rate setpoint, without the measured angles, (K, n, n)."""
        angle, rate, _ = self._model
        fixed = setpoint_rate_response(self.free.base.filters, self.plant.axes, self.plant.omega)
        found: Complex = self.matrices[ATTITUDE.matrix] * angle * self._delay + fixed
        return found + self.matrices[ATTITUDE_FEEDFORWARD.matrix] * rate if self._follows else found

    @property
    def _feeds_forward(self) -> bool:
        """Whether the setpoint acts otherwise than the measured attitude: C_ref is not C_o."""
        return self._follows or any(self.free.base.filters.shaping)

    @property
    def _follows(self) -> bool:
        return ATTITUDE_FEEDFORWARD.matrix in self.matrices

    @cached_property
    def C_ref(self) -> Complex:  # noqa: N802
        """From the attitude setpoint to u, loops open, (K, n, n)."""
        found: Complex = self.C_r @ self._rate_setpoint
        return found + self.matrices[ACCELERATION.matrix] * self._model[2] if self._follows else found

    @cached_property
    def U(self) -> Complex:  # noqa: N802
        """From the attitude setpoint to u, (K, n, n)."""
        return self.S @ self.C_ref

    @cached_property
    def T(self) -> Complex:  # noqa: N802
        """From the attitude setpoint to the attitude, (K, n, n)."""
        return self.plant.G_o @ self.U

    @cached_property
    def T_y(self) -> Complex:  # noqa: N802
        """From an offset of the measured attitude to the attitude, its sign reversed, (K, n, n).

        I - T_y is the sensitivity cut at the angles, and how an angle returns. It is T where nothing is fed forward.
        """
        found: Complex = self.plant.G_o @ self._U_y if self._feeds_forward else self.T
        return found

    @cached_property
    def _U_y(self) -> Complex:  # noqa: N802
        found: Complex = self.S @ self.C_o
        return found

    @cached_property
    def D(self) -> Complex:  # noqa: N802
        """From a torque disturbance to the attitude, (K, n, n)."""
        return self.plant.G_o @ self.S

    @cached_property
    def noise(self) -> Complex:
        """Square root of the spectrum of u that noise causes, (K, n, 2n)."""
        of_rates, of_angles = np.split(self.plant.noise, 2, axis=1)
        return self.S @ (self.C_y @ of_rates + self.C_o @ of_angles)

    def noise_rms(self, above: float = 0.0) -> Signal:
        """RMS of u at hover (normalised) that noise causes at frequencies above one (rad/s), (2,)."""
        weight = np.where(self.plant.omega > above, self.plant.noise_weight, 0.0)
        rms: Signal = np.sqrt(weight @ np.sum(np.abs(self.noise) ** 2, axis=2))
        return rms

    def loop_error(self, whole: bool) -> Signal:
        """RMS of the norm of the error of L_u, or of L_i, (K,): two standard deviations of an element."""
        error = self.C_y @ self.plant.error_i
        if whole:
            error = error + self.C_o @ self.plant.error_o
        size: Signal = np.linalg.norm(error, axis=(1, 2)) * np.linalg.norm(self.plant.reach, axis=(1, 2))
        return size

    @cached_property
    def _rows(self) -> Mapping[str, Complex]:
        """alpha, beta, gamma, delta, xi of the module's equations, beta of the rate loop alone, (K, n, ...) each."""
        count, n, N = len(self.plant.omega), self.plant.axes, self.plant.noise
        eye, delay = np.eye(n), self._delay[:, 0]
        Kp_o = self.matrices[ATTITUDE.matrix] * self._delay
        angle, noise_o = Kp_o @ self.plant.G_o, Kp_o @ N[:, n:]
        model_angle, model_rate, model_acceleration = (part[:, 0] for part in self._model)
        none, noiseless = np.zeros(n), np.zeros(2 * n)
        parts: dict[str, list[Complex]] = {name: [] for name in ("alpha", "beta", "gamma", "delta", "xi", "beta_i")}

        def add(**rows: NDArray[np.generic]) -> None:
            for name, row in rows.items():
                parts[name].append(np.broadcast_to(row, (count, row.shape[-1])))

        for name, row, column in self.free.places():
            if name == ATTITUDE.matrix:
                add(
                    alpha=self.C_r[:, :, row],
                    beta=self.plant.G_o[:, column] * delay,
                    gamma=model_angle * eye[column] * delay,
                    delta=eye[column] * delay,
                    xi=N[:, n + column] * delay,
                    beta_i=none,
                )
            elif name in LETTERS:
                of_r, of_y = (shape[:, :, column] for shape in self._shapes[name])
                add(
                    alpha=eye[row],
                    beta=of_y * self.plant.G_i[:, column] + of_r * angle[:, column],
                    gamma=of_r * self._rate_setpoint[:, column],
                    delta=of_r * Kp_o[:, column],
                    xi=of_y * N[:, column] + of_r * noise_o[:, column],
                    beta_i=of_y * self.plant.G_i[:, column],
                )
            else:  # feed-forward: outside of the loop
                first = name == ATTITUDE_FEEDFORWARD.matrix
                add(
                    alpha=self.C_r[:, :, row] if first else eye[row],
                    beta=none,
                    gamma=(model_rate if first else model_acceleration) * eye[column],
                    delta=none,
                    xi=noiseless,
                    beta_i=none,
                )
        size = self.free.size[None, :, None]
        found = {name: np.stack(rows, axis=1).astype(np.complex128) for name, rows in parts.items()}
        found["alpha"] = found["alpha"] * size
        return found

    @cached_property
    def _left(self) -> Complex:
        return self._rows["alpha"] @ self.S.transpose(0, 2, 1)

    @property
    def dL_u(self) -> ProductGradient:  # noqa: N802
        """Derivative of `L_u`."""
        return ProductGradient(self._rows["alpha"], self._rows["beta"])

    @property
    def dL_i(self) -> ProductGradient:  # noqa: N802
        """Derivative of `L_i`."""
        return ProductGradient(self._rows["alpha"], self._rows["beta_i"])

    @cached_property
    def dU(self) -> ProductGradient:  # noqa: N802
        """Derivative of `U`."""
        return ProductGradient(self._left, self._rows["gamma"] - self._rows["beta"] @ self.U)

    @cached_property
    def dT(self) -> ProductGradient:  # noqa: N802
        """Derivative of `T`."""
        return self.dU.after(self.plant.G_o)

    @cached_property
    def dT_y(self) -> ProductGradient:  # noqa: N802
        """Derivative of `T_y`."""
        if not self._feeds_forward:
            return self.dT
        return ProductGradient(self._left, self._rows["delta"] - self._rows["beta"] @ self._U_y).after(self.plant.G_o)

    @cached_property
    def dD(self) -> ProductGradient:  # noqa: N802
        """Derivative of `D`."""
        return ProductGradient(self._left, -self._rows["beta"] @ self.S).after(self.plant.G_o)

    @cached_property
    def dnoise(self) -> ProductGradient:
        """Derivative of `noise`."""
        return ProductGradient(self._left, self._rows["xi"] - self._rows["beta"] @ self.noise)
