"""A user's script, which type checkers read and nobody runs (test_types.py)."""

from pathlib import Path

import greybox
import numpy as np
import pandas as pd
from numpy.typing import NDArray

t = np.arange(100) / 50
frame = pd.DataFrame({"t": t, "theta": np.sin(t), "v [V]": np.cos(t)})
stages: list[str] = []

found = greybox.diagnose(
    "link.toml",
    ["run1.csv", Path("run2.mat")],
    holdout=frame,
    units={"theta": "deg"},
    map={"theta": "sensor_3 [deg]"},
    progress=stages.append,
)
verdict: str = found.verdict
for mechanism in found.mechanisms:
    kind: str = mechanism.kind
    level: float = mechanism.parameters["fc"].value
    interval = mechanism.parameters.fc.ci95
    if interval is not None:
        low: float = interval[0]
item: float = found.fit.holdout.improved["theta"].nrmse
attribute: float = found.fit.holdout.improved.theta.nrmse
values: dict[str, float] = {name: p.value for name, p in found.parameters.items()}
messages: list[str] = [finding.message for finding in found.findings]
measured: NDArray[np.float64] = found.curves[0].channels["theta"].measured
table: pd.DataFrame = found.frame("run1.csv")
page: str = found.report_html(Path("report.html"))

model: greybox.Model = found.model.with_parameters(J=0.003)
model.save("improved.toml")
run = greybox.simulate(model, {"t": t, "v [V]": t, "theta": [0.0] * 100})
theta: NDArray[np.float64] = run["theta"]
error: float = run.fit["theta"].nrmse
inertia: float = greybox.calibrate(model, frame).parameters.J.value
law = greybox.control(found, method="smc", track="theta", to=0.5, size={"theta": 0.2})
code: str = law.law_c
recordings: list[greybox.RecordingLike] = [frame, greybox.Recording(frame, "run 2")]
identified = greybox.identify(recordings, ["theta"], "v", library=["tensor", "friction"])
terms: list[str] = [term.expression for e in identified.equations.values() for term in e.terms]
health: str = greybox.check(recordings, inputs=["v"]).summary
try:
    greybox.Model("no_such.toml")
except greybox.InputError as refused:
    place: tuple[str | None, int | None, str | None] = refused.file, refused.line, refused.help
