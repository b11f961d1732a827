//! The model as data: names, values, units and equations, everything in SI.

use crate::expr::{BinOp, Expr, Func};
use crate::units::{Dimension, Unit, Units};

/// A mechanistic model: ordinary differential equations as a textbook writes them.
///
/// All numbers are SI; [`Unit`] keeps how the user wrote the unit, and its factor and offset to SI.
/// Names are unique over inputs, states and parameters.
#[derive(Debug, Clone, PartialEq)]
pub struct Model {
    /// Free text.
    pub name: String,
    /// Units that the model declares.
    pub units: Units,
    /// Exogenous signals, in the order of the file.
    pub inputs: Vec<Input>,
    /// Generalised coordinates and other states, in the order of the file.
    pub states: Vec<State>,
    /// Constants, in the order of the file.
    pub parameters: Vec<Parameter>,
    /// As many equations as states.
    pub equations: Vec<Equation>,
    /// What the recording's channels measure: for each measured state its own channel, then the
    /// explicit `[measurements]`.
    pub measurements: Vec<Measurement>,
}

/// What a digital or sampled input does between two samples.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub enum Hold {
    /// The sample's value is kept until the next sample (a digital-to-analogue converter).
    Zero,
    /// Straight line between samples.
    #[default]
    Linear,
    /// The band-limited signal through the samples (sinc interpolation).
    BandLimited,
}

/// An exogenous signal.
#[derive(Debug, Clone, PartialEq)]
pub struct Input {
    /// Name in the equations.
    pub name: String,
    /// Channel of the recording; `u'` is the derivative of the channel `u` with respect to time, unless the recording
    /// has a channel of that very name.
    pub channel: String,
    /// Unit of the signal in the equations.
    pub unit: Unit,
    /// Behaviour between samples.
    pub hold: Hold,
    /// Lowest and highest value that the actuator can make, SI, if stated.
    pub range: Option<[f64; 2]>,
}

impl Input {
    /// The channel whose derivative this input is, where its channel is called `u'`.
    ///
    /// ```
    /// # use greybox_model::Model;
    /// let model = Model::from_toml(r#"
    ///     [inputs]
    ///     u  = { unit = "m" }
    ///     du = { unit = "m/s", channel = "u'" }
    ///     [states]
    ///     x = { unit = "m" }
    ///     [parameters]
    ///     c = { value = 2, unit = "1/s" }
    ///     [equations]
    ///     base = "x'' + c*(x' - du) + c^2*(x - u) = 0"
    /// "#, "base.toml")?;
    /// assert_eq!(model.inputs[0].derivative_of(), None);
    /// assert_eq!(model.inputs[1].derivative_of(), Some("u"));
    /// # Ok::<(), greybox_model::ModelError>(())
    /// ```
    pub fn derivative_of(&self) -> Option<&str> {
        self.channel.strip_suffix('\'').filter(|base| !base.is_empty())
    }

    /// The column that it is read from in a recording with columns of which `has` tells: that of its channel, else that
    /// whose derivative it is.
    pub fn column(&self, has: impl Fn(&str) -> bool) -> &str {
        self.derivative_of().filter(|_| !has(&self.channel)).unwrap_or(&self.channel)
    }

    /// The hold of an input that states none: the slope of the straight lines between the samples of a channel is
    /// constant from each sample to the next.
    pub(crate) fn usual_hold(channel: &str) -> Hold {
        if channel.ends_with('\'') { Hold::Zero } else { Hold::default() }
    }
}

/// A coordinate (or any other state) with its time derivatives up to `order - 1`.
#[derive(Debug, Clone, PartialEq)]
pub struct State {
    /// Name in the equations.
    pub name: String,
    /// Unit of the undifferentiated state.
    pub unit: Unit,
    /// Highest number of primes in the equations (≥ 1).
    pub order: usize,
    /// Channel that measures it; `None` for `measured = false`.
    pub channel: Option<String>,
    /// Given start values [q, q', …] in SI; those missing are estimated from the recording.
    pub initial: Vec<f64>,
}

/// A constant of the model.
#[derive(Debug, Clone, PartialEq)]
pub struct Parameter {
    /// Name in the equations.
    pub name: String,
    /// Value in SI.
    pub value: f64,
    /// Unit as written; `None` when not stated, until [`Model::resolve_units`] infers it from the
    /// equations.
    pub unit: Option<Unit>,
    /// Prior 1-sigma in SI, if stated.
    pub std: Option<f64>,
    /// Known exactly: calibration never moves it.
    pub fixed: bool,
    /// Positive (`true`) or of either sign (`false`), if stated.
    pub positive: Option<bool>,
}

/// `lhs = rhs`
#[derive(Debug, Clone, PartialEq)]
pub struct Equation {
    /// Name in the file.
    pub name: String,
    /// Left side.
    pub lhs: Expr,
    /// Right side.
    pub rhs: Expr,
}

impl Equation {
    /// `lhs - rhs`, which is zero along solutions.
    pub fn residual(&self) -> Expr {
        if self.rhs == Expr::Num(0.0) { self.lhs.clone() } else { self.lhs.clone() - self.rhs.clone() }
    }
}

/// A channel of the recording as an expression of states, inputs and parameters.
#[derive(Debug, Clone, PartialEq)]
pub struct Measurement {
    /// The recording's channel.
    pub channel: String,
    /// What it measures.
    pub expr: Expr,
    /// Unit of the expression (in which results for this channel are printed).
    pub unit: Unit,
}

impl Model {
    /// Index of the state called `name`.
    pub fn state(&self, name: &str) -> Option<usize> {
        self.states.iter().position(|s| s.name == name)
    }

    /// Index of the input called `name`.
    pub fn input(&self, name: &str) -> Option<usize> {
        self.inputs.iter().position(|s| s.name == name)
    }

    /// The columns of a recording that the inputs are read from ([`Input::column`]), each once.
    pub fn input_columns(&self, has: impl Fn(&str) -> bool) -> Vec<&str> {
        let mut columns: Vec<&str> = Vec::with_capacity(self.inputs.len());
        for input in &self.inputs {
            let column = input.column(&has);
            if !columns.contains(&column) {
                columns.push(column);
            }
        }
        columns
    }

    /// Index of the parameter called `name`.
    pub fn parameter(&self, name: &str) -> Option<usize> {
        self.parameters.iter().position(|s| s.name == name)
    }

    /// Index of the equation called `name`.
    pub fn equation(&self, name: &str) -> Option<usize> {
        self.equations.iter().position(|s| s.name == name)
    }

    /// Index of the measurement of the state called `state` (`primes` 0) or of its derivative, and of nothing else.
    pub fn measurement_of(&self, state: &str, primes: u8) -> Option<usize> {
        self.measurements.iter().position(
            |m| matches!(&m.expr, Expr::Var { name, primes: p } if **name == *state && *p == primes),
        )
    }

    /// Whether an expression is a difference of temperatures: whether it stays as it is where all temperatures among
    /// states and inputs, and the parameters whose unit has a zero of its own, rise by the same amount.
    ///
    /// ```
    /// use greybox_model::{Model, parse};
    /// let model = Model::from_toml("[states]\nTi = { unit = \"degC\" }\nTe = { unit = \"degC\" }\n[parameters]\n\
    ///     tau = { value = 1, unit = \"h\" }\n[equations]\ni = \"tau*Ti' = Te - Ti\"\ne = \"tau*Te' = Ti - Te\"\n", "m.toml")?;
    /// let difference = |text| Ok::<bool, Box<dyn std::error::Error>>(model.is_difference(&parse(text)?.expr));
    /// assert!(difference("Ti - Te")? && difference("Ti'")?);
    /// assert!(!difference("Ti")? && !difference("(Ti + Te)/2")?);
    /// # Ok::<(), Box<dyn std::error::Error>>(())
    /// ```
    pub fn is_difference(&self, expr: &Expr) -> bool {
        self.shift(expr) == Some(0.0)
    }

    /// By how much an expression rises where all temperatures rise by 1 K; `None` where that is not one number.
    fn shift(&self, expr: &Expr) -> Option<f64> {
        match expr {
            Expr::Num(_) => Some(0.0),
            Expr::Var { primes, .. } if *primes > 0 => Some(0.0),
            Expr::Var { name, .. } => {
                let state = self.state(name).map(|i| &self.states[i].unit);
                let signal = state.or_else(|| self.input(name).map(|i| &self.inputs[i].unit));
                let parameter = self.parameter(name).and_then(|i| self.parameters[i].unit.as_ref());
                let absolute = signal.is_some_and(|u| u.dimension.same(&Dimension::TEMPERATURE))
                    || parameter.is_some_and(|u| u.offset != 0.0);
                Some(if absolute { 1.0 } else { 0.0 })
            }
            Expr::Neg(a) => Some(-self.shift(a)?),
            Expr::Bin(BinOp::Add, a, b) => Some(self.shift(a)? + self.shift(b)?),
            Expr::Bin(BinOp::Sub, a, b) => Some(self.shift(a)? - self.shift(b)?),
            Expr::Bin(BinOp::Mul, a, b) => match (self.shift(a)?, self.shift(b)?) {
                (0.0, 0.0) => Some(0.0),
                (0.0, s) => Some(a.constant()? * s),
                (s, 0.0) => Some(b.constant()? * s),
                _ => None,
            },
            Expr::Bin(BinOp::Div, a, b) => match (self.shift(a)?, self.shift(b)?) {
                (0.0, 0.0) => Some(0.0),
                (s, 0.0) => Some(s / b.constant()?),
                _ => None,
            },
            Expr::Bin(BinOp::Pow, a, b) => unmoved(&[self.shift(a)?, self.shift(b)?]),
            Expr::Call(Func::Delay, args) => self.shift(args.first()?),
            Expr::Call(_, args) => {
                let shifts: Option<Vec<f64>> = args.iter().map(|a| self.shift(a)).collect();
                unmoved(&shifts?)
            }
        }
    }
}

fn unmoved(shifts: &[f64]) -> Option<f64> {
    shifts.iter().all(|s| *s == 0.0).then_some(0.0)
}
