"""How soon river's detectors see what changes in a machine, and how often they cry wolf.

    cargo xtask prove --watch --only nothing --count 10 --keep DIR
    python detectors.py DIR

reads the recordings that `prove` kept: the residual of the calibrated model in free run, over its standard deviation in the
first minute. Every detector gets the residual and its square, sample by sample; an alarm of either counts. Of a row of
sensitivities, from the default on, the first counts that raises at most one alarm an hour on the machines to which
nothing happens, once where the model is right (cases 0 to 7) and once where it errs (8 and 9).
"""

import sys
from pathlib import Path

import numpy
from river import drift

CHANGE, LEARN, RATE = 600.0, 60.0, 100
CASES = {
    0: "Coulomb friction + 30 %",
    1: "Coulomb friction + 6 % a minute",
    2: "viscous friction + 30 %",
    3: "spring − 2 %",
    4: "load of 2 % of the largest torque",
    5: "sensor: offset of twice its noise",
    6: "sensor: noise + 50 %",
    8: "model lacks a stiffening: Coulomb friction + 30 %",
}
SOUND = {7: range(0, 7), 9: [8]}
DETECTORS = {
    "ADWIN": (lambda s: drift.ADWIN(delta=s), [2e-3, 1e-5, 1e-8, 1e-12, 1e-20, 1e-40, 1e-80, 1e-160]),
    "Page–Hinkley": (lambda s: drift.PageHinkley(threshold=s), [50, 200, 800, 3200, 12800, 51200]),
}


def residual(path):
    values = numpy.loadtxt(path, delimiter=",", skiprows=1, usecols=3)
    first = int(LEARN * RATE)
    return (values - values[:first].mean()) / values[:first].std()


def alarms(make, sensitivity, values):
    """Times of the alarms after the first minute."""
    detectors = [make(sensitivity), make(sensitivity)]
    times = []
    for k, value in enumerate(values):
        seen = False
        for detector, x in zip(detectors, (value, value * value)):
            detector.update(float(x))
            seen |= detector.drift_detected
        if seen and k > LEARN * RATE:
            times.append(k / RATE)
    return times


def main(folder):
    records = {}
    for path in sorted(folder.glob("*-*.csv")):
        case = int(path.stem.split("-")[0])
        records.setdefault(case, []).append(residual(path))
    for name, (make, sensitivities) in DETECTORS.items():
        for sound, cases in SOUND.items():
            hours = sum(len(r) for r in records[sound]) / RATE / 3600
            for sensitivity in sensitivities:
                rate = sum(len(alarms(make, sensitivity, r)) for r in records[sound]) / hours
                if rate <= 1.0:
                    break
            print(f"{name} at {sensitivity:g}: {rate:.2f} alarms an hour where nothing happens ({'model right' if sound == 7 else 'model errs'})")
            for case in cases:
                delays = []
                for values in records[case]:
                    after = [t - CHANGE for t in alarms(make, sensitivity, values) if t >= CHANGE]
                    delays.append(after[0] if after else numpy.inf)
                seen = sum(numpy.isfinite(delays))
                median = sorted(delays)[len(delays) // 2]
                print(f"  {CASES[case]}: seen {seen} of {len(delays)}, median {median:.1f} s")


main(Path(sys.argv[1]))
