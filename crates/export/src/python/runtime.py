def rhs(t, x, u, delayed=(), /, **parameters):
    """Time derivative of the state vector x (as STATES) at time t under the inputs u (as INPUTS).

    `delayed` holds the values of DELAYED. Every function takes its value at the point: sign(0) = 0.
    """
    p = _values(parameters)
    return _chain(x, *_equations(t, x, u, delayed, p, _at_point))


def outputs(t, x, u, delayed=(), /, **parameters):
    """What each channel of CHANNELS shows; `delayed` holds the values of DELAYED_OUTPUTS."""
    p = _values(parameters)
    z = None
    if OUTPUTS_NEED_HIGHEST:
        if DELAYED:
            raise NotImplementedError("a channel shows a highest derivative of a delayed equation: use simulate")
        z = _highest(*_equations(t, x, u, (), p, _at_point))
    return np.array(_outputs(t, x, z, u, delayed, p), dtype=float)


def simulate(t, inputs=None, initial=None, /, **parameters):
    """Simulates the model at the sample times t (rising; in the equations time counts from t[0]).

    inputs      name -> one sample for each time, SI; HOLDS says what happens between them
    initial     state -> start value, or [q, q', ...], SI; or the whole state vector, as STATES.
                What is not given starts from INITIAL, and from zero where that says nothing.
    parameters  new values, SI, for some of PARAMETERS

    Returns Result(t, outputs, states, events): dictionaries of arrays, SI. Where the simulation diverges the
    values are nan from there on.
    """
    times = np.asarray(t, dtype=float)
    if times.ndim != 1 or times.size < 1 or not np.all(np.isfinite(times)) or np.any(np.diff(times) <= 0):
        raise ValueError("t: give a one-dimensional array of finite, strictly rising times")
    run = _Run(times - times[0], _signals(times - times[0], inputs or {}), _start(initial), _values(parameters))
    y, x = run.all()
    return Result(
        times,
        {name: y[:, i] for i, name in enumerate(CHANNELS)},
        {name: x[:, i] for i, name in enumerate(STATES)},
        run.events,
    )


Result = collections.namedtuple("Result", "t outputs states events")

# Relative tolerance of the integration, and absolute tolerance in parts of what each state has reached.
RTOL = 1e-9
ATOL = 1e-11
# Events between two samples beyond which they are no longer located (a contact that bounces without end).
MOST_EVENTS = 200


def _values(parameters):
    unknown = [name for name in parameters if name not in PARAMETERS]
    if unknown:
        raise TypeError(f"no parameter is called {', '.join(unknown)}; there are {', '.join(PARAMETERS)}")
    return [float(parameters.get(name, value)) for name, value in PARAMETERS.items()]


def _start(initial):
    if initial is not None and not isinstance(initial, dict):
        x = np.array(initial, dtype=float)
        if x.shape != (len(STATES),):
            raise ValueError(f"initial: {len(STATES)} values are needed, in the order of STATES")
        return x
    given = {**INITIAL, **(initial or {})}
    x = np.zeros(len(STATES))
    for name, value in given.items():
        if name not in STATES:
            raise ValueError(f"initial: no state is called {name}; there are {', '.join(STATES)}")
        first = STATES.index(name)
        chain = 1
        while first + chain < len(STATES) and STATES[first + chain] == STATES[first] + "'" * chain:
            chain += 1
        values = np.atleast_1d(np.asarray(value, dtype=float))
        if values.ndim != 1 or not 1 <= values.size <= chain:
            raise ValueError(f"initial: {name} takes up to {chain} values")
        x[first : first + values.size] = values
    return x


def _signals(times, inputs):
    unknown = [name for name in inputs if name not in INPUTS]
    missing = [name for name in INPUTS if name not in inputs]
    if unknown or missing:
        raise ValueError(f"inputs: needed are {', '.join(INPUTS) or 'none'}")
    signals = []
    for name in INPUTS:
        samples = np.asarray(inputs[name], dtype=float)
        if samples.shape != times.shape or not np.all(np.isfinite(samples)):
            raise ValueError(f"inputs: {name} needs one finite sample for each time")
        signals.append(_Signal(HOLDS[name], times, samples))
    return signals


class _Signal:
    """A sampled input and what it does between its samples."""

    FINE = 8

    def __init__(self, hold, times, samples):
        self.hold = hold
        if hold == "band_limited" and len(samples) > 1:
            step = np.diff(times)
            if np.ptp(step) > 1e-6 * step.mean():
                raise ValueError("t: a band-limited input needs times at equal steps")
            fine = (len(samples) - 1) * self.FINE + 1
            times, samples = np.linspace(times[0], times[-1], fine), _upsampled(samples, self.FINE)
        self.times, self.samples = times.tolist(), samples.tolist()

    def at(self, t, inside):
        """Value and slope at t; `inside` lies in the same smooth stretch: it tells the side of a jump."""
        g, times = self.samples, self.times
        if inside < times[0]:
            return g[0], 0.0
        k = bisect.bisect_right(times, inside) - 1
        if k >= len(g) - 1:
            return g[-1], 0.0
        if self.hold == "zero":
            return g[k], 0.0
        h = times[k + 1] - times[k]
        w = (t - times[k]) / h
        b, c = g[k], g[k + 1]
        if self.hold == "linear":
            return b + w * (c - b), (c - b) / h
        # Cubic through the four neighbours on the fine grid.
        a = g[k - 1] if k > 0 else 2 * b - c
        d = g[k + 2] if k + 2 < len(g) else 2 * c - b
        c1 = c - a / 3 - b / 2 - d / 6
        c2 = 0.5 * (a + c) - b
        c3 = (d - a) / 6 + 0.5 * (b - c)
        return b + w * (c1 + w * (c2 + w * c3)), (c1 + w * (2 * c2 + 3 * w * c3)) / h


def _upsampled(u, factor, half=32, beta=9.0):
    """Band-limited interpolation by windowed sinc kernels (Kaiser), odd reflection beyond the ends."""
    n = len(u)
    last = n - 1

    def continued(k):
        offset, sign = 0.0, 1.0
        while not 0 <= k <= last:
            end = 0 if k < 0 else last
            offset, sign, k = offset + sign * 2 * u[end], -sign, 2 * end - k
        return offset + sign * u[k]

    padded = np.array([continued(k) for k in range(1 - half, n + half)])
    around = np.lib.stride_tricks.sliding_window_view(padded, 2 * half)[: n - 1]
    fine = np.empty((n - 1) * factor + 1)
    fine[::factor] = u
    for phase in range(1, factor):
        x = phase / factor + (half - 1) - np.arange(2 * half)
        weights = np.sinc(x) * np.i0(beta * np.sqrt(np.maximum(1 - (x / half) ** 2, 0)))
        weights /= weights.sum()
        fine[phase::factor] = u[:-1] + (around - u[:-1, None]) @ weights
    return fine


def _sign(a):
    return float((a > 0) - (a < 0))


def _deadzone(a, gap):
    return a - gap if a > gap else a + gap if a < -gap else 0.0


def _saturate(a, limit):
    return limit if a > limit else -limit if a < -limit else a


def _table(a, knots, values):
    if a <= knots[0]:
        return values[0]
    if a >= knots[-1]:
        return values[-1]
    i = 1
    while i < len(knots) - 1 and a >= knots[i]:
        i += 1
    slope = (values[i] - values[i - 1]) / (knots[i] - knots[i - 1])
    return values[i - 1] + slope * (a - knots[i - 1])


def _step(a, b):
    return 0.0 if a < b else 1.0


def _natural(kind, a, b):
    """The branch that the arguments ask for."""
    if kind == "sign":
        return (a > 0) - (a < 0)
    if kind == "abs":
        return -1 if a < 0 else 1
    if kind in ("deadzone", "saturate"):
        return (a > b) - (a < -b)
    return -1 if a < b else 1  # min, max, step


def _margin(kind, mode, a, b):
    """How far inside its branch: negative when it is left."""
    if kind in ("sign", "abs"):
        return mode * a
    if kind in ("deadzone", "saturate"):
        return b - abs(a) if mode == 0 else mode * a - b
    return mode * (a - b)


def _value(kind, mode, a, b):
    if kind == "sign":
        return float(mode)
    if kind == "abs":
        return mode * a
    if kind == "max":
        return a if mode > 0 else b
    if kind == "min":
        return b if mode > 0 else a
    if kind == "deadzone":
        return 0.0 if mode == 0 else a - mode * b
    if kind == "saturate":
        return a if mode == 0 else mode * b
    return 1.0 if mode > 0 else 0.0  # step


def _at_point(k, a, b=0.0):
    return _value(SWITCHES[k], _natural(SWITCHES[k], a, b), a, b)


def _highest(mass, force):
    """z of M z + h = 0: the highest derivatives."""
    if len(force) == 1:
        return [-force[0] / mass[0][0]]
    return np.linalg.solve(np.array(mass, dtype=float), -np.array(force, dtype=float)).tolist()


def _chain(x, mass, force):
    """The derivative of the state vector: each coordinate's chain moves up by one, and ends in z."""
    f = np.empty(len(STATES))
    f[:-1] = x[1:]
    f[LAST] = _highest(mass, force)
    return f


class _Run:
    """One simulation. Within a step every non-smooth function keeps its branch (its mode), so that the right-hand
    side is smooth; where an argument leaves the branch, the instant is located and the mode changes there.

    A sign whose argument g reaches zero sticks where a value in [-1, 1] keeps g at zero (Filippov's solution): that
    value follows from dg/dt = a + B value = 0, and the sign lets go where it would leave [-1, 1].
    """

    def __init__(self, times, signals, x, p):
        self.times, self.signals, self.p = times.tolist(), signals, p
        self.x0, self.x, self.t, self.inside = x, x.copy(), 0.0, 0.0
        self.modes = [1] * len(SWITCHES)
        self.sign = [0.0] * len(SWITCHES)  # values of signs that stick
        self.stuck = []
        self.pull = {}
        self.arguments = [(0.0, 0.0)] * len(SWITCHES)
        self.scale = [0.0] * len(SWITCHES)
        self.reach = np.abs(x)
        self.past_times, self.past = [], []
        self.events = 0
        self.tau = [max(value, 0.0) for value in _delay_times(p)]
        self.tau_outputs = [max(value, 0.0) for value in _output_delay_times(p)]
        # A step no longer than a delay reads only what is past.
        remembered = [tau for tau, delay in zip(self.tau, _DELAYED) if delay.on_state and tau > 0]
        self.longest_step = min(remembered, default=np.inf)
        self.remembers = any(delay.on_state for delay in _DELAYED + _DELAYED_OUTPUTS)
        self.rates_at_start = None
        self.step = self.times[1] if len(self.times) > 1 else 1.0

    def all(self):
        n = len(self.times)
        y, x = np.full((n, len(CHANNELS)), np.nan), np.full((n, len(STATES)), np.nan)
        try:
            self.start_modes()
            for k in range(n):
                y[k], x[k] = self.observe(k), self.x
                if k + 1 < n:
                    self.cross(self.times[k], self.times[k + 1])
        except (_Diverged, ArithmeticError, ValueError, np.linalg.LinAlgError) as error:
            warnings.warn(f"the simulation diverges at {self.t} s: {error}", RuntimeWarning, stacklevel=3)
        return y, x

    # The past.

    def inputs(self, t, inside):
        pairs = [signal.at(t, inside) for signal in self.signals]
        return [v for v, _ in pairs], [slope for _, slope in pairs]

    def state(self, t):
        if t <= 0:
            return self.x0
        if not self.past or t >= self.past_times[-1]:
            return self.x
        return self.past[bisect.bisect_right(self.past_times, t)](t)

    def delayed(self, t, inside, x, count=None):
        """The values of DELAYED, or of its first few."""
        taus = self.tau[:count]
        return [self.earlier(k, _DELAYED[k], tau, t, inside, x, self.delayed) for k, tau in enumerate(taus)]

    def earlier(self, k, delay, tau, t, inside, x, others):
        """An expression tau ago; before the start it has the value of the start."""
        at, inside = t - tau, inside - tau
        if inside < 0:
            at, inside, x = 0.0, 0.0, self.x0
        elif tau > 0 and delay.on_state:
            x = self.state(at)
        u, _ = self.inputs(at, inside)
        # A delay inside a delay stands before it in the list.
        inner = others(at, inside, x, k) if delay.nested else ()
        return delay.function(at, x, u, inner, self.p)

    # The right-hand side.

    def switch(self, k, a, b=0.0):
        self.arguments[k] = (a, b)
        if self.modes[k] == 0 and SWITCHES[k] == "sign":
            return self.sign[k]
        return _value(SWITCHES[k], self.modes[k], a, b)

    def derivative(self, t, x):
        try:
            return self.flow(t, x.tolist())
        except (ArithmeticError, ValueError, np.linalg.LinAlgError):
            return np.full(len(STATES), np.nan)

    def flow(self, t, x):
        u, slopes = self.inputs(t, self.inside)
        d = self.delayed(t, self.inside, x) if DELAYED else ()

        def evaluate():
            return _chain(x, *_equations(t, x, u, d, self.p, self.switch))

        if not self.stuck:
            return evaluate()
        for k in self.stuck:
            self.sign[k] = 0.0
        free = evaluate()
        gradients, rates, pulls = [], [], []
        for k in self.stuck:
            gradient, explicit = _SIGN_RATES[k](t, x, u, slopes, self.p)
            gradients.append(gradient)
            rates.append(explicit + float(np.dot(gradient, free)))
            self.sign[k] = 1.0
            pulls.append(evaluate() - free)
            self.sign[k] = 0.0
        b = np.array(gradients, dtype=float) @ np.array(pulls).T
        self.pull = dict(zip(self.stuck, np.diag(b)))
        try:
            values = np.linalg.solve(b, -np.array(rates))
        except np.linalg.LinAlgError:
            self.pull = dict.fromkeys(self.stuck, 0.0)
            return evaluate()
        for k, value in zip(self.stuck, values.tolist()):
            self.sign[k] = value
        f = evaluate()
        for k in self.stuck:
            # A velocity that is held does not change, not even by rounding.
            if SIGN_OF_STATE[k] is not None:
                f[SIGN_OF_STATE[k]] = 0.0
        return f

    # Modes.

    def slack(self, k):
        if self.modes[k] == 0 and SWITCHES[k] == "sign":
            return 1 - abs(self.sign[k]) + 1e-9
        return _margin(SWITCHES[k], self.modes[k], *self.arguments[k]) + 1e-12 * self.scale[k]

    def least_slack(self, t, x):
        f = self.derivative(t, x)
        if not np.all(np.isfinite(f)):
            return 0.0
        return min(map(self.slack, range(len(SWITCHES))))

    def note_scale(self):
        for k, (a, b) in enumerate(self.arguments):
            if math.isfinite(a) and math.isfinite(b):
                self.scale[k] = max(self.scale[k], abs(a), abs(b))

    def set_stuck(self):
        self.stuck = [k for k, kind in enumerate(SWITCHES) if kind == "sign" and self.modes[k] == 0]

    def natural_modes(self):
        self.modes = [_natural(kind, *ab) for kind, ab in zip(SWITCHES, self.arguments)]

    def start_modes(self):
        if not SWITCHES:
            return
        self.inside = 0.25 * self.step
        for _ in range(3):
            self.flow(0.0, self.x.tolist())
            self.natural_modes()
        self.note_scale()
        for k, kind in enumerate(SWITCHES):
            if kind == "sign" and self.modes[k] == 0:
                self.modes[k] = 1
                self.decide(k)

    def settle(self):
        """Modes at the start of a stretch: an input may have jumped."""
        for _ in range(8):
            self.flow(self.t, self.x.tolist())
            left = [k for k in range(len(SWITCHES)) if self.slack(k) < 0]
            if not left:
                break
            for k in left:
                if SWITCHES[k] == "sign" and self.modes[k] == 0:
                    self.modes[k] = 1 if self.sign[k] > 0 else -1
                else:
                    self.modes[k] = _natural(SWITCHES[k], *self.arguments[k])
            self.set_stuck()
        self.note_scale()

    def decide(self, k):
        """A sign has reached zero: it sticks where a value may hold it, else its argument crosses."""
        before = self.modes[k]
        self.modes[k] = 0
        self.set_stuck()
        self.flow(self.t, self.x.tolist())
        if self.pull[k] < 0:
            if abs(self.sign[k]) <= 1:
                if SIGN_OF_STATE[k] is not None:
                    self.x[SIGN_OF_STATE[k]] = 0.0
                return
            self.modes[k] = 1 if self.sign[k] > 0 else -1
        else:
            self.modes[k] = -before
        self.set_stuck()

    def event(self):
        self.events += 1
        self.flow(self.t, self.x.tolist())
        for k in [k for k in range(len(SWITCHES)) if self.slack(k) < 0]:
            kind, mode = SWITCHES[k], self.modes[k]
            if kind == "sign" and mode == 0:
                self.modes[k] = 1 if self.sign[k] > 0 else -1
                self.set_stuck()
            elif kind == "sign":
                self.decide(k)
            elif kind in ("deadzone", "saturate"):
                self.modes[k] = (-1 if self.arguments[k][0] < 0 else 1) if mode == 0 else 0
            else:
                self.modes[k] = -mode

    # Stepping.

    def cross(self, begin, end):
        """From one sample to the next, in stretches at whose edges alone a delayed input has its jumps and kinks."""
        edges = {end}
        for tau in self.tau:
            first, last = bisect.bisect_right(self.times, begin - tau), bisect.bisect_left(self.times, end - tau)
            edges.update(time + tau for time in self.times[first:last])
        events = self.events
        tiny = 1e-13 * (end - begin + end)
        for edge in sorted(edges):
            if edge - self.t > tiny:
                self.inside = 0.5 * (self.t + edge)
                self.advance(edge, events)
        self.t = end

    def advance(self, end, events):
        if SWITCHES:
            self.settle()
        while self.t < end:
            self.reach = np.maximum(self.reach, np.abs(self.x))
            solver = scipy.integrate.DOP853(
                self.derivative,
                self.t,
                self.x,
                end,
                rtol=RTOL,
                atol=ATOL * self.reach + 1e-30,
                max_step=self.longest_step,
                first_step=min(self.step, end - self.t),
            )
            while solver.status == "running":
                message = solver.step()
                if solver.status == "failed":
                    raise _Diverged(message)
                if np.any(np.abs(solver.y) > 1e9 * (1 + self.reach.max())):
                    raise _Diverged("a state leaves every bound")
                self.step = solver.h_abs
                locate = SWITCHES and self.events - events < MOST_EVENTS
                dense = solver.dense_output() if locate or self.remembers else None
                at = self.left(solver, dense) if locate else None
                if at is not None:
                    self.remember(at, dense)
                    self.t, self.x = at, dense(at)
                    self.event()
                    break
                self.remember(solver.t, dense)
                self.t, self.x = solver.t, solver.y
                if SWITCHES and not locate:
                    self.flow(self.t, self.x.tolist())
                    self.natural_modes()
                    self.set_stuck()

    def remember(self, until, dense):
        if self.remembers:
            self.past_times.append(until)
            self.past.append(dense)

    def left(self, solver, dense):
        """The instant within the last step at which a branch is left, if one is."""
        low = solver.t_old
        for share in (0.25, 0.5, 0.75, 1.0):
            high = solver.t_old + share * (solver.t - solver.t_old) if share < 1 else solver.t
            if self.least_slack(high, dense(high)) < 0:
                break
            low = high
        else:
            return None
        while True:
            middle = 0.5 * (low + high)
            if not low < middle < high:
                return high
            if self.least_slack(middle, dense(middle)) < 0:
                high = middle
            else:
                low = middle

    # What the channels show.

    def observe(self, k):
        t = self.times[k]
        after = self.times[k + 1] - t if k + 1 < len(self.times) else 1.0
        inside = t + 1e-6 * after
        u, _ = self.inputs(t, inside)
        x, z = self.x.tolist(), None
        if OUTPUTS_NEED_HIGHEST:
            self.inside = inside
            z = [self.flow(t, x)[i] for i in LAST]
        if self.rates_at_start is None and _DELAYED_OUTPUTS:
            self.inside = inside
            self.rates_at_start = self.flow(t, x)
        d = self.delayed_outputs(t, inside, x)
        return _outputs(t, x, z, u, d, self.p)

    def delayed_outputs(self, t, inside, x, count=None):
        """The values of DELAYED_OUTPUTS, or of their first few."""
        values = []
        for k, tau in enumerate(self.tau_outputs[:count]):
            delay = _DELAYED_OUTPUTS[k]
            if t < tau and delay.state is not None:
                # A measurement of a state goes straight back along its rate before the start.
                values.append(self.x0[delay.state] + (t - tau) * self.rates_at_start[delay.state])
            else:
                values.append(self.earlier(k, delay, tau, t, inside, x, self.delayed_outputs))
        return values


class _Diverged(Exception):
    pass
