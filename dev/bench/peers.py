"""The peers' side of `cargo xtask bench --peers`: one function per row.

    python peers.py ROW FOLDER

FOLDER holds what both sides start from: `NAME.f64` (little-endian doubles) and `settings.json`. A function prepares
its data and returns the work, a function without arguments whose result is the answer. The answer is printed once,
after a first call that warms everything up, with the CPU time of that call; then every line of standard input, a number of seconds, runs the work until
so much CPU time has passed and prints {"calls": …, "seconds": …}.
"""

import json
import os
import sys
import time

for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ[name] = "1"

import numpy as np


class Data:
    """What the Rust side wrote."""

    def __init__(self, folder):
        self.folder = folder
        with open(os.path.join(folder, "settings.json"), encoding="utf-8") as file:
            self.settings = json.load(file)

    def __getitem__(self, name):
        return np.fromfile(os.path.join(self.folder, name + ".f64"), dtype="<f8")

    def columns(self):
        """The design matrix, column-major as scikit-learn likes it."""
        return np.asfortranarray(self["columns"].reshape(self.settings["columns"], -1).T)


# ---------------------------------------------------------------------------------------------- sparse regression


def algorithm1(data):
    """Cross-validated LASSO for every order, K contiguous folds, the same λ; AIC on the rows."""
    from sklearn.linear_model import LassoCV

    columns, y = data.columns(), data["target"]
    n = len(y)
    # Unit columns and a unit target, so that α = λ/n is the λ of greybox.
    norms, size = np.linalg.norm(columns, axis=0), np.linalg.norm(y)
    x, target = np.asfortranarray(columns / norms), y / size
    orders = data.settings["orders"]
    alphas = np.array(data.settings["lambdas"]) / n
    parts = [np.asfortranarray(x[:, :count]) for count in orders]

    def work():
        lambdas, coefficients, curves, aic = [], [], [], []
        for part in parts:
            model = LassoCV(alphas=alphas, cv=data.settings["folds"], fit_intercept=False, max_iter=100_000)
            model.fit(part, target)
            residual = target - part @ model.coef_
            aic.append(n * np.log(residual @ residual / n) + 2 * np.count_nonzero(model.coef_))
            lambdas.append(model.alpha_ * n)
            coefficients.extend(model.coef_)
            # From the smallest α to the largest.
            curves.extend(model.mse_path_.mean(axis=1)[::-1] * size**2)
        return {"lambdas": lambdas, "coefficients": coefficients, "curves": curves, "aic": aic}

    return work


def algorithm2(data):
    """The LASSO path of every bootstrap sample (rows drawn with replacement)."""
    from sklearn.linear_model import lasso_path

    columns, y = data.columns(), data["target"]
    draws = data["draws"].astype(np.intp).reshape(data.settings["replicates"], -1)
    lambdas = np.array(data.settings["lambdas"])

    def work():
        found = []
        for draw in draws:
            x, target = columns[draw], y[draw]
            norms, size = np.linalg.norm(x, axis=0), np.linalg.norm(target)
            _, path, _ = lasso_path(
                np.asfortranarray(x / norms), target / size, alphas=lambdas / len(target), max_iter=100_000
            )
            found.append((path * (size / norms)[:, None]).T[::-1])
        return {"coefficients": np.array(found).ravel()}

    return work


def stlsq(data):
    """One fit with the optimiser of PySINDy, the library evaluated by NumPy."""
    import pysindy

    x, v, force, y = data["x"], data["v"], data["force"], data["target"]
    powers = data.settings["powers"]
    threshold = data.settings["threshold"]

    def work():
        library = np.column_stack([force] + [x**i * v**j for i, j in powers])
        optimizer = pysindy.STLSQ(threshold=threshold, alpha=0.0)
        optimizer.fit(library, y)
        return {"coefficients": optimizer.coef_.ravel()}

    return work


# ----------------------------------------------------------------------------------------------------- simulation


def duffing_lsoda(data):
    """The oscillator of thesis equation 2.18 by LSODA with a Python right-hand side."""
    from math import sin

    from scipy.integrate import solve_ivp

    settings = data.settings

    def rate(t, s):
        x, v = s
        f = 10.0 * sin(t) + 40.0 * sin(4.0 * t)
        return (v, (f - 6.0 * x - 0.1 * x**3 - v - 0.2 * v * x * x - v**3) / 2.0)

    t = np.arange(settings["samples"]) * settings["dt"]

    def work():
        run = solve_ivp(
            rate, (0.0, t[-1]), settings["start"], method="LSODA", t_eval=t, rtol=settings["rtol"], atol=settings["atol"]
        )
        return {"x": run.y[0]}

    return work


def duffing_numba(data):
    """The same by a compiled fixed-step RK4."""
    from math import sin

    from numba import njit

    settings = data.settings

    @njit(fastmath=True)
    def rate(t, x, v):
        f = 10.0 * sin(t) + 40.0 * sin(4.0 * t)
        return (f - 6.0 * x - 0.1 * x * x * x - v - 0.2 * v * x * x - v * v * v) * 0.5

    @njit(fastmath=True)
    def simulate(x, v, dt, samples, substeps):
        out = np.empty(samples)
        h = dt / substeps
        for k in range(samples):
            out[k] = x
            for i in range(substeps):
                t = k * dt + i * h
                a1 = rate(t, x, v)
                v2 = v + 0.5 * h * a1
                a2 = rate(t + 0.5 * h, x + 0.5 * h * v, v2)
                v3 = v + 0.5 * h * a2
                a3 = rate(t + 0.5 * h, x + 0.5 * h * v2, v3)
                v4 = v + h * a3
                a4 = rate(t + h, x + h * v3, v4)
                x += h / 6.0 * (v + 2.0 * (v2 + v3) + v4)
                v += h / 6.0 * (a1 + 2.0 * (a2 + a3) + a4)
        return out

    def work():
        x, v = settings["start"]
        return {"x": simulate(x, v, settings["dt"], settings["samples"], settings["substeps"])}

    return work


# ---------------------------------------------------------------------------------------------------- calibration


def _fit(data, simulate, diff_step):
    from scipy.optimize import least_squares

    y, settings = data["x"], data.settings
    first = np.concatenate([settings["guess"], settings["start"]])

    def work():
        found = least_squares(
            lambda p: simulate(p) - y, first, method="lm", x_scale=np.maximum(np.abs(first), 0.1), diff_step=diff_step
        )
        return {"parameters": found.x[:6]}

    return work


def calibration_numba(data):
    """Output error by least_squares (MINPACK) on a compiled RK4, one step per sample, the force linear between them."""
    from numba import njit

    force, dt = data["force"], data.settings["dt"]

    @njit(fastmath=True)
    def rate(f, x, v, k1, k3, c1, c2, c3, b):
        return b * f - k1 * x - k3 * x * x * x - c1 * v - c2 * v * x * x - c3 * v * v * v

    @njit(fastmath=True)
    def simulate(force, dt, k1, k3, c1, c2, c3, b, x, v):
        out = np.empty(force.size)
        h = dt
        for k in range(force.size):
            out[k] = x
            if k + 1 == force.size:
                break
            f0, f1 = force[k], force[k + 1]
            fm = 0.5 * (f0 + f1)
            a1 = rate(f0, x, v, k1, k3, c1, c2, c3, b)
            v2 = v + 0.5 * h * a1
            a2 = rate(fm, x + 0.5 * h * v, v2, k1, k3, c1, c2, c3, b)
            v3 = v + 0.5 * h * a2
            a3 = rate(fm, x + 0.5 * h * v2, v3, k1, k3, c1, c2, c3, b)
            v4 = v + h * a3
            a4 = rate(f1, x + h * v3, v4, k1, k3, c1, c2, c3, b)
            x += h / 6.0 * (v + 2.0 * (v2 + v3) + v4)
            v += h / 6.0 * (a1 + 2.0 * (a2 + a3) + a4)
        return out

    return _fit(data, lambda p: simulate(force, dt, *p), None)


def calibration_scipy(data):
    """The same on solve_ivp with a Python right-hand side: what is written by hand today.

    The difference step is that of an integrator with a tolerance of 1e-8; with the default one it does not converge."""
    from scipy.integrate import solve_ivp

    force, dt = data["force"], data.settings["dt"]
    values = force.tolist()
    last = len(values) - 1
    t = np.arange(len(values)) * dt

    def simulate(p):
        k1, k3, c1, c2, c3, b, x0, v0 = p.tolist()

        def rate(time, s):
            x, v = s
            at = time / dt
            k = min(int(at), last - 1)
            f = values[k] + (at - k) * (values[k + 1] - values[k])
            return (v, b * f - k1 * x - k3 * x**3 - c1 * v - c2 * v * x * x - c3 * v**3)

        return solve_ivp(rate, (0.0, t[-1]), (x0, v0), method="RK45", t_eval=t, rtol=1e-8, atol=1e-8).y[0]

    return _fit(data, simulate, 1e-4)


# -------------------------------------------------------------------------------------------------------- control

A = np.array([[-1.01887, 0.90506, -0.00215], [0.82225, -1.07741, -0.17555], [0.0, 0.0, -1.0]])
B = np.array([[0.0], [0.0], [1.0]])


def adamax(data):
    """Algorithm 3 on the grid of the F16, vectorised over the points."""
    points = data["points"].reshape(-1, 3)
    iterations = data.settings["iterations"]
    index = [(0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)]
    gradients = np.zeros((len(points), 6, 3))
    for k, (i, j) in enumerate(index):
        gradients[:, k, i] += points[:, j]
        gradients[:, k, j] += points[:, i]
    drift = np.ascontiguousarray(np.einsum("pki,pi->pk", gradients, points @ A.T))
    inputs = np.ascontiguousarray(gradients @ B[:, 0])
    cost = np.sum(points**2, axis=1)

    def work():
        w, m, u = np.ones(6), np.zeros(6), np.zeros(6)
        decay = 1.0
        for _ in range(iterations):
            c = inputs @ w
            e = drift @ w - 0.25 * c * c + cost
            g = e @ drift - (0.5 * e * c) @ inputs
            m = 0.9 * m + 0.1 * g
            u = np.maximum(0.999 * u, np.abs(g))
            decay *= 0.9
            w = w - 0.001 / (1.0 - decay) * m / u
        return {"weights": w}

    return work


def riccati_scipy(data):
    """The Riccati equation of the F16."""
    from scipy.linalg import solve_continuous_are

    q, r = np.eye(3), np.eye(1)
    return lambda: {"solution": solve_continuous_are(A, B, q, r).ravel()}


def riccati_slycot(data):
    """The regulator of the F16 by python-control on SLICOT."""
    import control

    q, r = np.eye(3), np.eye(1)

    def work():
        _, solution, _ = control.lqr(A, B, q, r, method="slycot")
        return {"solution": np.asarray(solution).ravel()}

    return work


# ------------------------------------------------------------------------------------------------------- protocol


def main():
    row, folder = sys.argv[1:3]
    answers, sys.stdout = sys.stdout, sys.stderr
    work = globals()[row](Data(folder))
    start = time.process_time()
    found = work()
    seconds = time.process_time() - start
    answer = {key: np.asarray(value).tolist() for key, value in found.items()}
    print(json.dumps({"answer": answer, "seconds": seconds}), file=answers, flush=True)
    for line in sys.stdin:
        wanted, calls = float(line), 0
        start = time.process_time()
        while True:
            work()
            calls += 1
            seconds = time.process_time() - start
            if seconds >= wanted:
                break
        print(json.dumps({"calls": calls, "seconds": seconds}), file=answers, flush=True)


if __name__ == "__main__":
    main()
