"""The thesis' pseudo-code of the cascade, literally: Kronecker products, one sample after the other.

It is the reference for the fast estimator, and for its time in the benchmark. Two differences from the print: phi
transposed in steps 3 and 9, and + Kd on y in the inverse controller, since D is subtracted.
"""

import numpy as np


def literal_cascade(u, y_i, y_o, inner, outer, Ts, cutoff_hz, lags):
    """Kp, Ki, Kd of the rate loop and Kp of the attitude loop, (2, 2) each: W = I, instrument u, no trim."""
    B = literal_loop(u, y_i, inner, ("P", "I", "D"), Ts, cutoff_hz, lags, settling=0)
    Kp, Ki, Kd = B[:, 0:2], B[:, 2:4], B[:, 4:6]
    r_i, settling = literal_inverse(u, y_i, Kp, Ki, Kd, Ts, cutoff_hz)
    return Kp, Ki, Kd, literal_loop(r_i, y_o, outer, ("P",), Ts, cutoff_hz, lags, settling, instrument=u)


def literal_loop(u, y, model, terms, Ts, cutoff_hz, lags, settling, instrument=None):
    instrument = u if instrument is None else instrument
    drop = settling + model.settling_samples()
    y_l, u_l, w = literal_filter(model, y), literal_filter(model, u)[drop:], literal_filter(model, instrument)[drop:]
    e_l = y - y_l
    columns = []
    for term in terms:
        if term == "P":
            columns.append(e_l)
        elif term == "I":
            total = np.zeros(2)
            sums = []
            for e in e_l:
                total = total + Ts * e
                sums.append(total)
            columns.append(np.array(sums))
        else:
            columns.append(-literal_derivative(y_l, Ts, cutoff_hz))
    x = np.hstack(columns)[drop:]
    n_x, N, size = x.shape[1], len(x), 2 * (2 * lags + 1)
    padded = np.vstack([np.zeros((lags, 2)), w, np.zeros((lags, 2))])
    R, r = np.zeros((2 * size, 2 * n_x)), np.zeros(2 * size)
    for k in range(N):
        zeta = padded[k : k + 2 * lags + 1].ravel()
        phi_transposed = np.kron(x[k], np.eye(2))  # u_l(k) = phi'(k) theta, theta = vec(B)
        instrument_matrix = np.kron(zeta[:, None], np.eye(2))
        R += instrument_matrix @ phi_transposed / N
        r += instrument_matrix @ u_l[k] / N
    theta = np.linalg.solve(R.T @ R, R.T @ r)
    return theta.reshape(n_x, 2).T


def literal_filter(model, signal):
    """num(z)/den(z) z^-delay as a difference equation."""
    taps, den = model.taps, model.den
    out = np.zeros_like(signal)
    for k in range(len(signal)):
        for i, b in enumerate(taps):
            if k >= i:
                out[k] += b * signal[k - i]
        for i, a in enumerate(den[1:], start=1):
            if k >= i:
                out[k] -= a * out[k - i]
    return out


def literal_derivative(y, Ts, cutoff_hz):
    a = np.exp(-2 * np.pi * cutoff_hz * Ts) if cutoff_hz else 0.0
    d = np.zeros_like(y)
    for k in range(1, len(y)):
        d[k] = a * d[k - 1] + (1 - a) * (y[k] - y[k - 1]) / Ts
    return d


def literal_inverse(u, y, Kp, Ki, Kd, Ts, cutoff_hz):
    """(3.32)-(3.34), and the settling time of the unknown initial integrator, samples."""
    inverse = np.linalg.inv(Kp + Ts * Ki)
    d = literal_derivative(y, Ts, cutoff_hz)
    integral, r = np.zeros(2), np.zeros_like(y)
    for k in range(len(u)):
        e = inverse @ (u[k] - integral + Kd @ d[k])
        integral = integral + Ts * Ki @ e
        r[k] = e + y[k]
    slowest = np.abs(np.linalg.eigvals(np.eye(2) - Ts * Ki @ inverse)).max()
    return r, int(np.ceil(np.log(0.01) / np.log(slowest)))
