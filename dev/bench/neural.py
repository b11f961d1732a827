"""A neural state-space model beside greybox, on the same records of the oscillator of the thesis (2.18).

    python neural.py GREYBOX [FOLDER]

in the environment of requirements-neural.txt; GREYBOX is the command. Training and validation records are multisines from
0.05 to 1 Hz; the network is linear paths beside one hidden layer (jax-sysid's RNN, Adam and then L-BFGS on the simulation
error). Its size and seed are chosen by the free run on the validation record; greybox does not see that record. `identify` gets no
equation, `diagnose` the linear oscillator without the terms in x³, x² x' and x'³. All models run freely
over the test records, from an initial state estimated on their first quarter.
"""

import os

os.environ["XLA_FLAGS"] = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"

import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import flax.linen as nn
import jax
import numpy as np
from jax_sysid.models import RNN
from scipy.integrate import solve_ivp

jax.config.update("jax_enable_x64", True)

STEP, NOISE = 0.05, 0.01
M, K1, K3, C1, C2, C3 = 2.0, 6.0, 0.1, 1.0, 0.2, 1.0
LENGTHS, VALIDATION, TEST = [30.0, 120.0], 30.0, 40.0
SIZES, SEEDS = [(2, 16), (4, 8), (4, 16)], range(3)
ADAM, LBFGS = 500, 1000
FREQUENCIES = np.arange(1, 21) * 0.05
NOMINAL = f"""name = "linear oscillator"

[inputs]
f = {{ unit = "N", hold = "zero" }}

[states]
x = {{ unit = "m" }}

[parameters]
m = {{ value = {M}, unit = "kg" }}
k = {{ value = {K1}, unit = "N/m" }}
c = {{ value = {C1}, unit = "N s/m" }}

[equations]
motion = "m*x'' + c*x' + k*x = f"
"""


def multisine(seed):
    phases = np.random.default_rng(seed).uniform(0, 2 * np.pi, len(FREQUENCIES))
    return lambda t: 7.0 * np.sin(2 * np.pi * np.outer(t, FREQUENCIES) + phases).sum(axis=1)


def record(force, seconds, seed):
    """Force, held over a step, and measured position."""
    t = np.arange(int(seconds / STEP)) * STEP
    u = force(t)
    state, x = np.array([0.0, 0.0]), []
    for held in u:
        x.append(state[0])

        def rate(_, s):
            return [s[1], (held - K1 * s[0] - K3 * s[0] ** 3 - C1 * s[1] - C2 * s[0] ** 2 * s[1] - C3 * s[1] ** 3) / M]

        state = solve_ivp(rate, (0, STEP), state, rtol=1e-9, atol=1e-10).y[:, -1]
    return t, u, np.array(x) + NOISE * np.random.default_rng(seed + 1000).normal(size=len(t))


def tests():
    usual = multisine(50)
    return {
        "another multisine": record(usual, TEST, 50),
        "the force of the thesis": record(lambda t: 10 * np.sin(t) + 40 * np.sin(4 * t), TEST, 51),
        "a square wave of 40 N, 0.1 Hz": record(lambda t: 40 * np.sign(np.sin(2 * np.pi * 0.1 * t + 1e-9)), TEST, 52),
        "a multisine of half the size": record(lambda t: 0.5 * usual(t), TEST, 53),
        "a multisine of twice the size": record(lambda t: 2 * usual(t), TEST, 54),
    }


def error(x, simulated):
    """Root mean square after the first quarter, over the standard deviation of the measured position, in %."""
    first = len(x) // 4
    with np.errstate(all="ignore"):
        return 100 * np.sqrt(np.mean((x - simulated)[first:] ** 2)) / np.std(x)


class Network:
    """x⁺ = A x + B u + MLP(x, u), y = C x + D u, on scaled signals."""

    def __init__(self, states, hidden, seed, u, y):
        class Update(nn.Module):
            @nn.compact
            def __call__(self, xu):
                return nn.Dense(states)(xu) + nn.Dense(states, use_bias=False)(nn.tanh(nn.Dense(hidden)(xu)))

        class Output(nn.Module):
            @nn.compact
            def __call__(self, xu):
                return nn.Dense(1)(xu)

        self.u, self.y = (u.mean(), u.std()), (y.mean(), y.std())
        self.model = RNN(states, 1, 1, FX=Update, FY=Output, x_scaling=0.1, seed=seed)
        self.model.loss(rho_x0=1e-4, rho_th=1e-6)
        self.model.optimization(adam_eta=0.01, adam_epochs=ADAM, lbfgs_epochs=LBFGS, iprint=-1)
        start = time.process_time()
        self.model.fit(self.scaled(y, self.y), self.scaled(u, self.u))
        self.seconds = time.process_time() - start
        self.parameters = sum(np.size(p) for p in self.model.params)

    @staticmethod
    def scaled(signal, by):
        return ((signal - by[0]) / by[1]).reshape(-1, 1)

    def run(self, u, y):
        u, first = self.scaled(u, self.u), len(y) // 4
        start = self.model.learn_x0(u[:first], self.scaled(y[:first], self.y), verbosity=False)
        return np.asarray(self.model.predict(start, u)[0]).ravel() * self.y[1] + self.y[0]


def save(path, measured):
    t, u, x = measured
    np.savetxt(path, np.array([t, u, x]).T, delimiter=",", header="t [s],f [N],x [m]", comments="", fmt="%.12g")


def call(*arguments):
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run([str(a) for a in arguments], check=True, stdout=subprocess.DEVNULL)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def judged(greybox, folder, model):
    """Errors of a model of greybox on the test records."""
    errors = []
    for k, (_, _, x) in enumerate(tests().values()):
        call(greybox, "simulate", model, folder / f"test{k}.csv", "--out", folder / "simulated.csv")
        errors.append(error(x, np.genfromtxt(folder / "simulated.csv", delimiter=",", skip_header=1)[:, 1]))
    return errors


def networks(train, validation, measured):
    tried, spent = [], 0.0
    for states, hidden in SIZES:
        for seed in SEEDS:
            network = Network(states, hidden, seed, train[1], train[2])
            spent += network.seconds
            score = error(validation[2], network.run(validation[1], validation[2]))
            tried.append((score if np.isfinite(score) else np.inf, len(tried), network, states, hidden))
            print(f"  {states} states, {hidden} hidden, seed {seed}: {score:.2f} %, {network.seconds:.0f} s", file=sys.stderr)
    _, _, best, states, hidden = min(tried)
    name = f"network: {states} states, {hidden} hidden, {best.parameters} parameters"
    return name, spent, [error(x, best.run(u, x)) for _, u, x in measured]


def main():
    greybox = Path(sys.argv[1])
    folder = Path(sys.argv[2] if len(sys.argv) > 2 else tempfile.mkdtemp())
    folder.mkdir(parents=True, exist_ok=True)
    measured, validation = tests(), record(multisine(40), VALIDATION, 40)
    for k, test in enumerate(measured.values()):
        save(folder / f"test{k}.csv", test)
    (folder / "nominal.toml").write_text(NOMINAL)
    print("| training | model | CPU time |", " | ".join(measured), "|")
    print("|" + " --- |" * (3 + len(measured)))
    for seconds in LENGTHS:
        train = record(multisine(30), seconds, 30)
        save(folder / "train.csv", train)
        rows = [networks(train, validation, measured.values())]
        spent = call(greybox, "identify", folder / "train.csv", "--states", "x", "--inputs", "f", "--hold", "zero", "--out", folder / "identify")
        rows.append(("greybox identify", spent, judged(greybox, folder, folder / "identify" / "model.toml")))
        spent = call(greybox, "diagnose", folder / "nominal.toml", folder / "train.csv", "--out", folder / "diagnose")
        rows.append(("greybox diagnose, linear model given", spent, judged(greybox, folder, folder / "diagnose" / "improved.toml")))
        spent = call(greybox, "calibrate", folder / "nominal.toml", folder / "train.csv", "--out", folder / "calibrate")
        rows.append(("greybox calibrate, the linear model refitted", spent, judged(greybox, folder, folder / "calibrate" / "model.toml")))
        rows.append(("the noise of the measurement alone", 0.0, [100 * NOISE / np.std(x) for _, _, x in measured.values()]))
        for name, spent, errors in rows:
            cells = [f"{e:.2g} %" if np.isfinite(e) and e < 1000 else "diverges" for e in errors]
            print(f"| {seconds:.0f} s | {name} | {spent:.1f} s |", " | ".join(cells), "|", flush=True)


if __name__ == "__main__":
    main()
