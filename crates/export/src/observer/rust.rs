//! An observer in Rust without the standard library.

use super::fill::{fill, list};
use super::{ChainText, ObserverCode, ObserverForm};
use crate::language::number;

const PREDICT: &str = "/// The states a time later under a command: classical Runge-Kutta steps.
#[allow(clippy::all)]
fn predict(estimate: &mut [f64; @N1@], command: f64, time: f64, steps: u32) {
    let h = time / f64::from(steps);
    let input = [command + estimate[@N@]];
    let mut x = [0.0; @N@];
    x.copy_from_slice(&estimate[..@N@]);
    for _ in 0..steps {
        let k1 = @RATE@(&x, &input);
        let k2 = @RATE@(&core::array::from_fn(|i| x[i] + 0.5 * h * k1[i]), &input);
        let k3 = @RATE@(&core::array::from_fn(|i| x[i] + 0.5 * h * k2[i]), &input);
        let k4 = @RATE@(&core::array::from_fn(|i| x[i] + h * k3[i]), &input);
        for i in 0..@N@ {
            x[i] += h / 6.0 * (k1[i] + 2.0 * k2[i] + 2.0 * k3[i] + k4[i]);
        }
    }
    estimate[..@N@].copy_from_slice(&x);
}

";

const OBSERVER: &str = "/// What the observer remembers between two samples.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Observer {
    /// The states, then the disturbance.
    pub estimate: [f64; @N1@],
    command: f64,
    /// Behind the dead zone, the latest first.
    past: [f64; @PAST@],
    started: bool,
@FIELDS@@RESTING@}

#[allow(clippy::all)]
impl Observer {
    /// Before the first sample.
    #[must_use]
    pub const fn new() -> Observer {
        Observer {
            estimate: [0.0; @N1@],
            command: 0.0,
            past: [0.0; @PAST@],
            started: false,
@ZEROS@@UNMOVED@        }
    }

    /// In the place of `new` at a machine that rests at its measurements under a held command: the estimate is that state of
    /// rest, and what else holds it is the disturbance. With the set point where the machine rests, `step` then begins
    /// with that command. None where a number is none, or no state of rest is found.
    #[must_use]
    pub fn start_at(measured: &[f64; @M@], command: f64) -> Option<Observer> {
        const GAP: f64 = @GAP@;
        let held = if command > GAP { command - GAP } else if command < -GAP { command + GAP } else { 0.0 };
        if !command.is_finite() || !measured.iter().all(|y| y.is_finite()) {
            return None;
        }
        let mut start = Observer::new();
@BALANCE@        start.past = [held; @PAST@];
        start.command = command;
        start.started = true;
@OFFSET@        Some(start)
    }
@EXPLAIN@
    /// Once a sample, every @DT@ s: the command from the measurements and the set point. A measurement that is not a
    /// number is left out. `law` is `@LAW@`.
    pub fn step(
        &mut self,
        measured: &[f64; @M@],
        set_point: &[f64; @R@],
        law: impl Fn(&[f64; @N@], &[f64; 1], &[f64; @R@]) -> [f64; 1],
    ) -> f64 {
        const PLACE: [usize; @M@] = [@PLACES@];
        const GAP: f64 = @GAP@;
        let u = self.command;
        self.past.copy_within(0..@OLDEST@, 1);
        self.past[0] = if u > GAP { u - GAP } else if u < -GAP { u + GAP } else { 0.0 };
        if !self.started {
            for i in 0..@M@ {
                self.estimate[PLACE[i]] = if measured[i].is_finite() { measured[i] } else { 0.0 };
            }
        }@ESTIMATE@        self.started = true;
@AHEAD@        let mut x = [0.0; @N@];
        x.copy_from_slice(&ahead[..@N@]);
@COMMAND@        self.command
    }
}

impl Default for Observer {
    fn default() -> Self {
        Self::new()
    }
}
";

const FIELDS: &str = "    chain: [f64; @SIZE@],
    last: [f64; @K@],
    begun: [bool; @K@],
";

const ZEROS: &str = "            chain: [0.0; @SIZE@],
            last: [0.0; @K@],
            begun: [false; @K@],
";

const KALMAN: &str = " else {
            const GAIN: [[f64; @M@]; @N1@] = [@GAIN@];
@PREDICTIONS@            let innovation: [f64; @M@] = core::array::from_fn(|i| {
                if measured[i].is_finite() { measured[i] - self.estimate[PLACE[i]] } else { 0.0 }
            });
            for i in 0..@N1@ {
                for j in 0..@M@ {
                    self.estimate[i] += GAIN[i][j] * innovation[j];
                }
            }
        }
";

const BALANCE: &str = "        const PLACE: [usize; @M@] = [@PLACES@];
        const SIZE: [f64; @N1@] = @SIZES@;
        const TOWARD: [[f64; @NM@]; @N1@] = [@MATRIX@];
        let mut estimate: [f64; @N1@] = @POINT@;
        estimate[@N@] -= held;
        let mut last = f64::INFINITY;
        for _ in 0..@STEPS@ {
            let mut x = [0.0; @N@];
            x.copy_from_slice(&estimate[..@N@]);
            let mut off = [0.0; @NM@];
            off[..@N@].copy_from_slice(&@RATE@(&x, &[held + estimate[@N@]]));
            for j in 0..@M@ {
                off[@N@ + j] = x[PLACE[j]] - measured[j];
            }
            let (mut change, mut length) = ([0.0; @N1@], 0.0);
            for i in 0..@N1@ {
                for j in 0..@NM@ {
                    change[i] += TOWARD[i][j] * off[j];
                }
                length += change[i] / SIZE[i] * (change[i] / SIZE[i]);
            }
            if !length.is_finite() || length >= last {
                break;
            }
            for i in 0..@N1@ {
                estimate[i] -= change[i];
            }
            last = length;
            if length <= @LAST@ * @LAST@ {
                break;
            }
        }
        if last > @CLOSE@ * @CLOSE@ {
            return None;
        }
        start.estimate = estimate;
";

const CHAIN_AT_REST: &str = "        start.chain[@START@] = measured[@AT@];
        start.chain[@LAST@] = @AGAINST@ * held;
        start.estimate[@FIRST@] = measured[@AT@];
        start.last[@K@] = measured[@AT@];
        start.begun[@K@] = true;
";

const EXPLAINED: &str = "        start.explain(held);
";

const OFFSET: &str = "        start.offset = start.estimate[@N@];
";

const EXPLAIN: &str = "
    /// The disturbance: what the equations do not explain of the highest derivatives.
    fn explain(&mut self, acting: f64) {
        let mut x = [0.0; @N@];
        x.copy_from_slice(&self.estimate[..@N@]);
        let rest = @RATE@(&x, &[acting]);
        let moved = @RATE@(&x, &[acting + 1.0]);
        let (mut above, mut below) = (0.0, 0.0);
@DISTURBANCES@        self.estimate[@N@] = if below > 0.0 { above / below } else { 0.0 };
    }
";

const ESO: &str = "
        let acting = @ACTING@;
@CHAINS@        self.explain(acting);
";

const CHAIN: &str = "        {
            const A: [[f64; @SIZE@]; @SIZE@] = [@A@];
            const BEFORE: [f64; @SIZE@] = @BEFORE@;
            const NOW: [f64; @SIZE@] = @NOW@;
            const G: [f64; @SIZE@] = @INPUT@;
            let z = &mut self.chain[@START@..@END@];
            let mut y = measured[@AT@];
            let known = y.is_finite();
            if self.begun[@K@] {
                let mut next = [0.0; @SIZE@];
                for i in 0..@SIZE@ {
                    next[i] = BEFORE[i] * self.last[@K@] + G[i] * acting;
                    for j in 0..@SIZE@ {
                        next[i] += A[i][j] * z[j];
                    }
                }
                // Without a measurement, the one that is expected.
                if !known {
                    y = next[0] / (1.0 - NOW[0]);
                }
                for i in 0..@SIZE@ {
                    z[i] = next[i] + NOW[i] * y;
                }
                self.last[@K@] = y;
            } else if known {
                z[0] = y;
                self.last[@K@] = y;
                self.begun[@K@] = true;
            }
            for i in 0..@ORDER@ {
                self.estimate[@FIRST@ + i] = z[i];
            }
        }
";

const DISTURBANCE: &str = "        let lumped = self.chain[@LAST@] + @GAIN@ * acting;
        above += @WEIGHT@ * (moved[@ROW@] - rest[@ROW@]) * (lumped - rest[@ROW@]);
        below += @WEIGHT@ * (moved[@ROW@] - rest[@ROW@]) * (moved[@ROW@] - rest[@ROW@]);
";

const AHEAD: &str = "        // The law acts on the states that its command will meet.
        let mut ahead = self.estimate;
";

const RESTING: &str = "    /// The integral action at rest.
    pub offset: f64,
    reading: f64,
    reference: f64,
    held: [f64; @N@],
    stayed: Option<u32>,
    holds: bool,
";

const UNMOVED: &str = "            offset: 0.0,
            reading: 0.0,
            reference: 0.0,
            held: [0.0; @N@],
            stayed: None,
            holds: false,
";

const SLOW: &str = " || (@X@[@RATE@] < @VELOCITY@ && @X@[@RATE@] > -@VELOCITY@)";

const REST: &str = "        // At rest the law is given the reading, and of the other states the estimate as it was; the offset moves while
        // the reading stays.
        const STEP: f64 = @STEP@;
        let (y, r) = (measured[@AT@], set_point[0]);
        let (moved, error) = (y - self.reading, r - y);
        let is_new = self.stayed.is_none() || self.reference != r;
        self.reference = r;
        let stayed = match self.stayed {
            Some(stayed) if !is_new && moved <= 0.5 * STEP && moved >= -0.5 * STEP => {
                if stayed < @SAMPLES@ { stayed + 1 } else { stayed }
            }
            _ => {
                self.reading = y;
                0
            }
        };
        self.stayed = Some(stayed);
        let stays = stayed == @SAMPLES@;
        if is_new || !y.is_finite() || !(stays@SLOW@) {
            self.holds = false;
            self.command = law(&@X@, &[self.offset], set_point)[0];
        } else {
            if !self.holds {
                self.held = @X@;
            }
            self.holds = true;
            self.held[@TRACKED@] = y;
            self.command = law(&self.held, &[self.offset], set_point)[0];
            if stays && (error > STEP || error < -STEP) {
                let mut edge = self.held;
                edge[@TRACKED@] = if error > 0.0 { r - STEP } else { r + STEP };
                let change = self.command - law(&edge, &[self.offset], set_point)[0];
                if change.is_finite() {
                    self.offset -= change * @DT@ / @TIME@;
                }
                self.command = law(&self.held, &[self.offset], set_point)[0];
            }
        }
";

/// What follows the machine's equations in the observer's file.
pub(super) fn write(code: &ObserverCode) -> String {
    let (n, m, delay) = (code.states(), code.measured.len(), code.input_delay.0);
    let n1 = n + 1;
    let (k, size) = (code.chains().len(), code.chains().iter().map(|c| c.a.len()).sum::<usize>());
    let chained = |text: &str| match k {
        0 => String::new(),
        k => fill(text, &[("SIZE", &size), ("K", &k)]),
    };
    let mut out: String =
        code.summary.iter().map(|l| format!("// {}\n", crate::language::comment(l))).collect();
    out.push('\n');
    if code.predicts() {
        out.push_str(&fill(PREDICT, &[("N", &n), ("N1", &n1), ("RATE", &code.rate.name)]));
    }
    let text = ChainText {
        explain: EXPLAIN,
        whole: ESO,
        rest: CHAIN_AT_REST,
        chain: CHAIN,
        disturbance: DISTURBANCE,
        row: brackets,
        past: "self.past",
    };
    let (estimate, balance, explain) = match &code.form {
        ObserverForm::Kalman { gain, start } => {
            let estimate = fill(
                KALMAN,
                &[
                    ("N1", &n1),
                    ("M", &m),
                    ("GAIN", &list(gain.iter().map(|row| brackets(row)))),
                    ("PREDICTIONS", &code.over_a_sample(&predict("            ", "self.estimate"))),
                ],
            );
            (estimate, start.write(BALANCE, brackets, code), String::new())
        }
        ObserverForm::Chains(chains) => {
            let balance = text.at_rest(code, chains) + EXPLAINED;
            (text.write(code, chains), balance, text.explained(code, chains))
        }
    };
    let resting = |text: &str| code.rest.as_ref().map_or_else(String::new, |_| fill(text, &[("N", &n)]));
    let command = match &code.rest {
        Some(rest) => rest.write(REST, SLOW, "x", code),
        None => format!("        self.command = law(&x, &[ahead[{n}]], set_point)[0];\n"),
    };
    let ahead = if code.is_delayed() {
        let predictions = code.over_the_delay(&predict("        ", "ahead"), "i", &|call| {
            format!("        for i in (0..{delay}).rev() {{\n    {call}        }}\n")
        });
        format!("{AHEAD}{predictions}")
    } else {
        "        let ahead = self.estimate;\n".to_owned()
    };
    out.push_str(&fill(
        OBSERVER,
        &[
            ("N", &n),
            ("N1", &n1),
            ("M", &m),
            ("PAST", &(delay + 2)),
            ("COMMAND", &command),
            ("RESTING", &resting(RESTING)),
            ("UNMOVED", &resting(UNMOVED)),
            ("BALANCE", &balance),
            ("EXPLAIN", &explain),
            ("OFFSET", &resting(OFFSET)),
            ("FIELDS", &chained(FIELDS)),
            ("ZEROS", &chained(ZEROS)),
            ("R", &code.references()),
            ("DT", &number(code.dt)),
            ("LAW", &code.law.name),
            ("PLACES", &list(code.measured.iter().map(usize::to_string))),
            ("GAP", &number(code.dead_zone)),
            ("OLDEST", &(delay + 1)),
            ("ESTIMATE", &estimate),
            ("AHEAD", &ahead),
        ],
    ));
    out
}

/// A call that predicts `x` over a time under a command of the past.
fn predict(indent: &'static str, x: &'static str) -> impl Fn(&str, (f64, usize)) -> String {
    move |past, (time, steps)| {
        format!("{indent}predict(&mut {x}, self.past[{past}], {}, {steps});\n", number(time))
    }
}

fn brackets(row: &[f64]) -> String {
    format!("[{}]", list(row.iter().map(|v| number(*v))))
}
