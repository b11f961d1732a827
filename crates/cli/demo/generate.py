"""Makes train.csv and holdout.csv: a cart on a spring with dry friction, which model.toml leaves out.

Semi-implicit Euler at 20 kHz with true sticking; Gaussian noise of 0.05 mm, then an encoder step of 0.1 mm.
"""
import math
import random

MASS, DAMPING, STIFFNESS, FRICTION = 1.2, 0.8, 43.0, 0.6
STEP, FINE, ROWS = 0.01, 200, 2000


def force(t, tones):
    return sum(a * math.sin(2 * math.pi * f * t + p) for a, f, p in tones)


def record(name, seed):
    rng = random.Random(seed)
    tones = [(a, f, rng.uniform(0, 2 * math.pi)) for a, f in
             [(1.2, 0.15), (1.0, 0.4), (0.8, 0.7), (0.6, 1.3), (0.5, 2.1), (0.4, 3.4)]]
    x = v = 0.0
    h = STEP / FINE
    # The input is a line between its samples, as the model says (`hold = "linear"`).
    u = [round(force(k * STEP, tones), 5) for k in range(ROWS + 1)]
    lines = ["t,f [N],x [mm]"]
    for k in range(ROWS):
        measured = round((1000 * x + rng.gauss(0, 0.05)) / 0.1) * 0.1
        lines.append(f"{k * STEP:.2f},{u[k]:.5f},{measured:.1f}")
        for j in range(FINE):
            drive = u[k] + (u[k + 1] - u[k]) * j / FINE - DAMPING * v - STIFFNESS * x
            free = v + h * drive / MASS
            slip = h * FRICTION / MASS
            v = 0.0 if abs(free) <= slip else free - math.copysign(slip, free)
            x += h * v
    with open(name, "w", encoding="utf-8", newline="\n") as file:
        file.write("\n".join(lines) + "\n")


record("train.csv", 1)
record("holdout.csv", 2)
