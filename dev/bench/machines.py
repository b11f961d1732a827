"""How often PySINDy finds the equations of machines with several coordinates.

    cargo xtask prove --identify --only machine: --count 20 --keep DIR
    python machines.py DIR

reads the recordings that `prove` kept. The library is that of greybox's proof: a constant and powers of single columns up to
the third. States are positions and velocities (PySINDy's
equations are of first order) of smoothed positions; columns are scaled to unit deviation, so that one threshold suits all.
For every recording the threshold is chosen as a user can, by the error of predicted derivatives on the last quarter with a
price for each term (BIC), and, in parentheses, by looking at the truth.
"""

import sys
import warnings
from pathlib import Path

import numpy
import pysindy
from scipy.signal import savgol_filter

warnings.filterwarnings("ignore")
THRESHOLDS = numpy.geomspace(2e-3, 0.3, 12)
WINDOW, DEGREE = 21, 4

CHAINS = {"chain2-1": (2, [0]), "chain2-2": (2, [1]), "chain2-12": (2, [0, 1]), "chain3-2": (3, [1]), "chain3-13": (3, [0, 2])}


def truth(name):
    """Measured columns with the order of their equations, and what stands in each equation."""
    if name == "drive":
        motion, current = {"theta'", "i", "load"}, {"i", "theta'", "v"}
        return [("theta", 2), ("i", 1)], [motion, current]
    count, driven = CHAINS[name]
    equations = []
    for mass in range(count):
        near = [m for m in (mass - 1, mass, mass + 1) if 0 <= m < count]
        terms = {f"x{m + 1}" for m in near} | {f"x{m + 1}'" for m in near}
        equations.append(terms | ({f"f{mass + 1}"} if mass in driven else set()))
    return [(f"x{m + 1}", 2) for m in range(count)], equations


def read(path):
    names = [cell.split(" ")[0] for cell in path.open().readline().strip().split(",")]
    table = numpy.loadtxt(path, delimiter=",", skiprows=1)
    return dict(zip(names, table.T))


def first_order(table, states):
    """Columns of the first-order form and the indices of the equations that are judged."""
    step = table["t"][1] - table["t"][0]
    names, columns, judged = [], [], []
    for name, order in states:
        names.append(name)
        columns.append(savgol_filter(table[name], WINDOW, DEGREE))
        if order == 2:
            names.append(name + "'")
            columns.append(savgol_filter(table[name], WINDOW, DEGREE, deriv=1, delta=step))
        judged.append(len(names) - 1)
    return names, numpy.array(columns).T, judged


def value_of(feature, names, columns):
    """A feature `1`, `x` or `x^2` along the columns."""
    if feature == "1":
        return numpy.ones(len(columns))
    name, _, power = feature.partition("^")
    return columns[:, names.index(name)] ** int(power or 1)


def fits(names, x, inputs, t, weak):
    """A model for every threshold: for each equation, the names of its terms, and the error on the last quarter."""
    cut = 3 * len(t) // 4
    input_names = list(inputs)
    u = numpy.array([inputs[n] for n in input_names]).T
    scale_x, scale_u = x.std(axis=0), u.std(axis=0)
    x, u = x / scale_x, u / scale_u
    library = pysindy.PolynomialLibrary(degree=3, include_interaction=False)
    for threshold in THRESHOLDS:
        optimizer = pysindy.STLSQ(threshold=threshold, alpha=1e-6)
        if weak:
            numpy.random.seed(0)
            both = pysindy.WeakPDELibrary(
                function_library=library, spatiotemporal_grid=t[:cut], K=200, H_xt=[0.3], is_uniform=True, include_bias=True
            )
            model = pysindy.SINDy(optimizer=optimizer, feature_library=both)
        else:
            model = pysindy.SINDy(optimizer=optimizer, feature_library=library)
        try:
            model.fit(x[:cut], t=t[:cut] if weak else t[1] - t[0], u=u[:cut], feature_names=names + input_names)
            found = [
                {name for name, value in zip(model.get_feature_names(), row) if value != 0.0}
                for row in model.coefficients()
            ]
            features = numpy.array([value_of(f, names + input_names, numpy.hstack([x, u])[cut:]) for f in model.get_feature_names()])
        except (ValueError, numpy.linalg.LinAlgError):
            continue
        derivative = savgol_filter(x, WINDOW, DEGREE, deriv=1, delta=t[1] - t[0], axis=0)[cut:]
        error = ((features.T @ model.coefficients().T - derivative) ** 2).mean(axis=0)
        yield found, error


def judge(path, weak):
    """Whether all equations are exact: by the user's choice of thresholds, and by the best one."""
    name = path.stem.rsplit("-", 1)[0]
    table = read(path)
    states, expected = truth(name)
    inputs = {n: v for n, v in table.items() if n != "t" and n not in dict(states)}
    names, x, judged = first_order(table, states)
    found = list(fits(names, x, inputs, table["t"], weak))
    rows = len(table["t"]) / 4 / WINDOW
    chosen, best = True, True
    for equation, terms in zip(judged, expected):
        price = [rows * numpy.log(error[equation]) + len(f[equation]) * numpy.log(rows) for f, error in found]
        chosen &= bool(price) and found[int(numpy.argmin(price))][0][equation] == terms
        best &= any(f[equation] == terms for f, _ in found)
    return chosen, best


def main():
    folder = Path(sys.argv[1])
    print("| machine | weak form | smoothed differences |\n| --- | --- | --- |")
    for name in [*CHAINS, "drive"]:
        cells = []
        for weak in (True, False):
            results = [judge(path, weak) for path in sorted(folder.glob(f"{name}-*.csv")) if path.stem.rsplit("-", 1)[0] == name]
            chosen, best = (sum(r[i] for r in results) for i in (0, 1))
            cells.append(f"{chosen} of {len(results)} ({best})")
        print(f"| {name} | {cells[0]} | {cells[1]} |", flush=True)


if __name__ == "__main__":
    main()
