//! An observer with its law, as code that is called once a sample.

mod c;
mod fill;
mod rust;

use self::fill::{fill, list};
use crate::error::ExportError;
use crate::function::Function;
use crate::language::{Language, number};

/// A law that is given what sensors measure, and the observer between them. The machine's equations are ẋ = `rate`, its
/// disturbance d adds to the command.
///
/// ```
/// use greybox_export::{Function, Group, Language, Member, ObserverCode, ObserverForm, StartForm};
/// use greybox_model::parse;
/// let group = |name: &str, member: &str| Group { name: name.into(), members: vec![Member::new(member, 0, "")] };
/// let function = |name: &str, arguments: Vec<Group>, output: &str| -> Result<Function, Box<dyn std::error::Error>> {
///     let outputs = vec![(String::new(), parse(output)?.expr)];
///     Ok(Function { name: name.into(), summary: vec![], arguments, constants: vec![], outputs })
/// };
/// // A tank, x' = u − x + d; its level is measured every 10 ms.
/// let state = || group("state", "x");
/// let code = ObserverCode {
///     summary: vec!["Level of a tank.".into()],
///     rate: function("plant_rate", vec![state(), group("command", "u")], "u - x")?,
///     law: function("control_law", vec![state(), group("disturbance", "d"), group("set_point", "r")], "r - 2*(x - r) - d")?,
///     dt: 0.01,
///     measured: vec![0],
///     dead_zone: 0.0,
///     substeps: 1,
///     input_delay: (0, 0.0),
///     form: ObserverForm::Kalman {
///         gain: vec![vec![0.4], vec![3.0]],
///         // At rest x = y and d = y − u.
///         start: StartForm {
///             point: vec![0.0, 0.0],
///             sizes: vec![1.0, 1.0],
///             matrix: vec![vec![0.0, 1.0], vec![1.0, 1.0]],
///             most_steps: 50,
///             last_step: 1e-10,
///             close: 1e-6,
///         },
///     },
///     rest: None,
/// };
/// assert!(code.code(Language::C99)?.contains("double observer_step(observer_memory *memory, const double measured[1]"));
/// assert!(code.code(Language::C99)?.contains("int observer_start_at(observer_memory *memory, const double measured[1], double command)"));
/// assert!(code.code(Language::Rust)?.contains("pub struct Observer"));
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Debug, Clone, PartialEq)]
pub struct ObserverCode {
    /// Lines of the comment at the top.
    pub summary: Vec<String>,
    /// ẋ: arguments `state` (n) and `command` (1), n outputs.
    pub rate: Function,
    /// The command: arguments `state` (n), `disturbance` (1) and `set_point` (1, or 3 with
    /// its derivatives), one output. Its code is a file of its own.
    pub law: Function,
    /// Sample time, s.
    pub dt: f64,
    /// Indices of the measured states, in the order of the measurements.
    pub measured: Vec<usize>,
    /// Half width of the actuator's dead zone.
    pub dead_zone: f64,
    /// Classical Runge–Kutta steps of a prediction over one sample, at least one.
    pub substeps: usize,
    /// The delay of the command: whole samples, and what is left, less than one, s.
    pub input_delay: (usize, f64),
    /// The observer's equations.
    pub form: ObserverForm,
    /// Integral action at rest, whose offset is the law's `disturbance` in place of the estimated one.
    pub rest: Option<RestForm>,
}

/// Integral action of a law for a machine that sticks. At rest the law is given the reading of the tracked state and
/// otherwise the estimate of the moment at which the machine came to rest; the offset moves while the reading stays and
/// is more than a step off.
#[derive(Debug, Clone, PartialEq)]
pub struct RestForm {
    /// Step of the reading: rest while it stays within half of it, no error while it is within it of the set point.
    pub step: f64,
    /// Samples for which the reading stays before the machine is at rest.
    pub samples: usize,
    /// The state that is the rate of the tracked one and the speed below which the machine is at rest too.
    pub slow: Option<(usize, f64)>,
    /// Index of the tracked state.
    pub tracked: usize,
    /// Its index among the measurements.
    pub measurement: usize,
    /// Integral time, s.
    pub integral_time: f64,
}

/// The equations of an observer.
#[derive(Debug, Clone, PartialEq)]
pub enum ObserverForm {
    /// Prediction by the machine's equations, then the correction (x̂, d̂) + `gain` (y − C x̂).
    Kalman {
        /// (n + 1) rows, one entry for each measurement.
        gain: Vec<Vec<f64>>,
        /// Where it starts at a machine at rest.
        start: StartForm,
    },
    /// Chains z⁺ = A z + b₀ y + b₁ y⁺ + g u; the last entry of each, with b u, is what its highest derivative is.
    Chains(Vec<ChainForm>),
}

/// Where a Kalman filter starts at a machine that rests at measurements y under a held command u: the state of rest and the
/// disturbance z = (x, d) that belong to them, from `point` − (0, u) by
///
/// ```text
/// z ← z − matrix (rate(x, u + d), C x − y)
/// ```
#[derive(Debug, Clone, PartialEq)]
pub struct StartForm {
    /// The states and the command of a rest: (n + 1).
    pub point: Vec<f64>,
    /// What a step is counted in: (n + 1), positive.
    pub sizes: Vec<f64>,
    /// (n + 1) rows of n and as many entries as there are measurements.
    pub matrix: Vec<Vec<f64>>,
    /// Most steps; one that is not shorter than the last is left out and ends them.
    pub most_steps: usize,
    /// A step this small is the last.
    pub last_step: f64,
    /// Largest last step of a rest that was found.
    pub close: f64,
}

/// The observer of one coordinate and its derivatives.
#[derive(Debug, Clone, PartialEq)]
pub struct ChainForm {
    /// Index of the coordinate among the states; its derivatives follow.
    pub first: usize,
    /// A, row by row: one more than the coordinate has states.
    pub a: Vec<Vec<f64>>,
    /// b₀.
    pub before: Vec<f64>,
    /// b₁.
    pub now: Vec<f64>,
    /// g.
    pub input: Vec<f64>,
    /// b, the command's gain in the highest derivative.
    pub gain: f64,
    /// Weight of this coordinate in d̂, 1/size² of its highest derivative.
    pub weight: f64,
}

impl ObserverCode {
    /// The observer's file, with the equations in it and the law called by name.
    ///
    /// # Errors
    /// As [`Function::code`].
    pub fn code(&self, language: Language) -> Result<String, ExportError> {
        self.law.check()?;
        let equations = self.rate.code(language)?;
        let observer = match language {
            Language::C99 => c::write(self),
            Language::Rust => rust::write(self),
        };
        Ok(format!("{equations}\n{observer}"))
    }

    fn states(&self) -> usize {
        self.rate.outputs.len()
    }

    /// Entries of the set point.
    fn references(&self) -> usize {
        self.law.arguments.last().map_or(1, |group| group.members.len())
    }

    fn chains(&self) -> &[ChainForm] {
        match &self.form {
            ObserverForm::Kalman { .. } => &[],
            ObserverForm::Chains(chains) => chains,
        }
    }

    /// Where each chain begins in what is remembered of all.
    fn starts(&self) -> Vec<usize> {
        let sizes = self.chains().iter().map(|c| c.a.len());
        sizes.scan(0, |at, size| Some(std::mem::replace(at, *at + size))).collect()
    }

    /// Which measurement a chain follows.
    fn measurement(&self, chain: &ChainForm) -> usize {
        self.measured.iter().position(|i| *i == chain.first).unwrap_or(0)
    }

    /// A time, and the steps of a prediction over it.
    fn span(&self, time: f64) -> (f64, usize) {
        (time, ((time / self.dt * self.substeps as f64 - 1e-9).ceil() as usize).max(1))
    }

    /// Whether the code predicts: a Kalman filter from sample to sample, any observer over the delay of the command.
    fn predicts(&self) -> bool {
        matches!(self.form, ObserverForm::Kalman { .. }) || self.is_delayed()
    }

    fn is_delayed(&self) -> bool {
        self.input_delay.0 > 0 || self.input_delay.1 > 0.0
    }

    /// The predictions from the last sample to this one: first under the older command, where a part of a sample is late.
    fn over_a_sample(&self, predict: &dyn Fn(&str, (f64, usize)) -> String) -> String {
        let (samples, remainder) = self.input_delay;
        let older = (remainder > 0.0).then(|| predict(&(samples + 1).to_string(), self.span(remainder)));
        older.unwrap_or_default() + &predict(&samples.to_string(), self.span(self.dt - remainder))
    }

    /// The predictions over the delay; `repeated` makes a loop, from the oldest command to the
    /// latest, of a call with `index`.
    fn over_the_delay(
        &self,
        predict: &dyn Fn(&str, (f64, usize)) -> String,
        index: &str,
        repeated: &dyn Fn(&str) -> String,
    ) -> String {
        let (samples, remainder) = self.input_delay;
        let older = (remainder > 0.0).then(|| predict(&samples.to_string(), self.span(remainder)));
        let whole = (samples > 0).then(|| repeated(&predict(index, self.span(self.dt))));
        older.unwrap_or_default() + &whole.unwrap_or_default()
    }

    /// The mean command since the last sample.
    fn acting(&self, past: &str) -> String {
        let (samples, remainder) = self.input_delay;
        if remainder == 0.0 {
            return format!("{past}[{samples}]");
        }
        let share = number(remainder / self.dt);
        format!("{share} * {past}[{}] + (1.0 - {share}) * {past}[{samples}]", samples + 1)
    }
}

impl RestForm {
    /// `text`, of a language, with the gaps filled; `x` is the estimate that the law is given.
    fn write(&self, text: &str, slow: &str, x: &str, code: &ObserverCode) -> String {
        let slow = self.slow.map_or_else(String::new, |(rate, velocity)| {
            fill(slow, &[("RATE", &rate), ("VELOCITY", &number(velocity)), ("X", &x)])
        });
        fill(
            text,
            &[
                ("STEP", &number(self.step)),
                ("AT", &self.measurement),
                ("SAMPLES", &self.samples),
                ("SLOW", &slow),
                ("X", &x),
                ("N", &code.states()),
                ("TRACKED", &self.tracked),
                ("DT", &number(code.dt)),
                ("TIME", &number(self.integral_time)),
                ("LAW", &code.law.name),
            ],
        )
    }
}

impl StartForm {
    /// `text`, of a language, with the gaps filled.
    fn write(&self, text: &str, row: fn(&[f64]) -> String, code: &ObserverCode) -> String {
        let (n, m) = (code.states(), code.measured.len());
        fill(
            text,
            &[
                ("N", &n),
                ("N1", &(n + 1)),
                ("M", &m),
                ("NM", &(n + m)),
                ("PLACES", &list(code.measured.iter().map(usize::to_string))),
                ("POINT", &row(&self.point)),
                ("SIZES", &row(&self.sizes)),
                ("MATRIX", &list(self.matrix.iter().map(|entries| row(entries)))),
                ("STEPS", &self.most_steps),
                ("LAST", &number(self.last_step)),
                ("CLOSE", &number(self.close)),
                ("RATE", &code.rate.name),
            ],
        )
    }
}

/// How a language writes extended-state observers.
struct ChainText {
    /// What finds the disturbance from the chains.
    explain: &'static str,
    whole: &'static str,
    /// The chain of a machine at rest.
    rest: &'static str,
    chain: &'static str,
    disturbance: &'static str,
    /// A list of numbers.
    row: fn(&[f64]) -> String,
    /// What the last commands are called.
    past: &'static str,
}

impl ChainText {
    /// The chains of a machine at rest.
    fn at_rest(&self, code: &ObserverCode, chains: &[ChainForm]) -> String {
        let at_rest = |(k, (chain, start)): (usize, (&ChainForm, &usize))| {
            fill(
                self.rest,
                &[
                    ("START", start),
                    ("LAST", &(start + chain.a.len() - 1)),
                    ("AT", &code.measurement(chain)),
                    ("K", &k),
                    ("FIRST", &chain.first),
                    ("AGAINST", &number(-chain.gain)),
                ],
            )
        };
        chains.iter().zip(&code.starts()).enumerate().map(at_rest).collect()
    }

    /// What finds the disturbance from the chains.
    fn explained(&self, code: &ObserverCode, chains: &[ChainForm]) -> String {
        let disturbance = |(chain, start): (&ChainForm, &usize)| {
            fill(
                self.disturbance,
                &[
                    ("LAST", &(start + chain.a.len() - 1)),
                    ("GAIN", &number(chain.gain)),
                    ("WEIGHT", &number(chain.weight)),
                    ("ROW", &(chain.first + chain.a.len() - 2)),
                ],
            )
        };
        fill(
            self.explain,
            &[
                ("N", &code.states()),
                ("RATE", &code.rate.name),
                ("DISTURBANCES", &chains.iter().zip(&code.starts()).map(disturbance).collect::<String>()),
            ],
        )
    }

    fn write(&self, code: &ObserverCode, chains: &[ChainForm]) -> String {
        let starts = code.starts();
        let step = |(k, (chain, start)): (usize, (&ChainForm, &usize))| {
            fill(
                self.chain,
                &[
                    ("SIZE", &chain.a.len()),
                    ("ORDER", &(chain.a.len() - 1)),
                    ("A", &list(chain.a.iter().map(|row| (self.row)(row)))),
                    ("BEFORE", &(self.row)(&chain.before)),
                    ("NOW", &(self.row)(&chain.now)),
                    ("INPUT", &(self.row)(&chain.input)),
                    ("START", start),
                    ("END", &(start + chain.a.len())),
                    ("AT", &code.measurement(chain)),
                    ("K", &k),
                    ("FIRST", &chain.first),
                ],
            )
        };
        fill(
            self.whole,
            &[
                ("ACTING", &code.acting(self.past)),
                ("CHAINS", &chains.iter().zip(&starts).enumerate().map(step).collect::<String>()),
            ],
        )
    }
}
