//! A model as a plant ẋ = f(x) + g(x) u in symbols.

use greybox_hjb::Linear;
use greybox_model::Expr;
use nalgebra::DMatrix;

use crate::compiled::Compiled;
use crate::error::{ControlError, listed};

/// The share of a velocity's size over which its friction changes sign, [`PlantOptions::smoothing`].
pub const SMOOTHING: f64 = 1e-2;

/// What is chosen about a plant. Names of states carry their primes: `theta`, `theta'`.
#[derive(Debug, Clone, PartialEq)]
pub struct PlantOptions {
    /// Typical sizes of states, SI; 1 where none is stated. They are the measure of everything: of weights (Bryson),
    /// of the width of smoothed friction, of convergence.
    pub sizes: Vec<(String, f64)>,
    /// Typical size of the input, SI.
    pub input_size: f64,
    /// Friction `sign(v)` becomes tanh(v/ε) with ε this share of the size of v.
    pub smoothing: f64,
    /// Other inputs and the constants that they are held at; zero where none is stated.
    pub held: Vec<(String, f64)>,
    /// States that the design leaves out, and the constants that they are held at: memories of friction, which
    /// nothing brings to rest. Its derivatives are zero, but for a highest one that stands in the equation of
    /// another state.
    pub frozen: Vec<(String, f64)>,
    /// Design as if `deadzone(d, gap)` of a state were d: within a gap nothing pulls, so that the tangent there cannot
    /// be controlled. [`Plant::closed_gaps`] tells which.
    pub close_gaps: bool,
    /// Design as if `delay(u, tau)` of the command were u, for a law whose observer predicts over the delay
    /// ([`OutputFeedback`](crate::OutputFeedback)); [`Plant::input_delay`] tells how long it is.
    pub predict_input_delay: bool,
    /// Drop additive terms with the time (disturbances); [`Plant::dropped`] tells which.
    pub ignore_time_terms: bool,
}

impl Default for PlantOptions {
    fn default() -> Self {
        Self {
            sizes: Vec::new(),
            input_size: 1.0,
            smoothing: SMOOTHING,
            held: Vec::new(),
            frozen: Vec::new(),
            close_gaps: false,
            predict_input_delay: false,
            ignore_time_terms: false,
        }
    }
}

/// A term that a design left out.
#[derive(Debug, Clone, PartialEq)]
pub struct Dropped {
    /// Name of the equation.
    pub equation: String,
    /// The term, as it stands on the left side.
    pub term: Expr,
}

/// A plant with one input,
///
/// ```text
/// ẋ = f(x) + g(x) u        low ≤ u ≤ high
/// ```
///
/// from equations that are affine in their highest derivatives, M(x) z + h(x) + k(x) u = 0: z = −M⁻¹ (h + k u), in
/// symbols. The state vector holds q, q′, … of every state in the order of the model, as [`greybox_model::System`] has
/// it. Parameters stay names, so that a law made from f and g can be read.
///
/// Friction has two forms here. In f and g `sign(v)` is tanh(v/ε); designs linearise the plant with `sign` dropped
/// ([`frictionless_tangent`](Self::frictionless_tangent)), for the slope of a smoothed friction at rest has nothing
/// to do with what happens in motion.
///
/// ```
/// use greybox_control::{Plant, PlantOptions};
/// use greybox_model::Model;
/// let model = Model::from_toml(r#"
/// [inputs]
/// tau = { unit = "N m" }
/// [states]
/// theta = { unit = "rad" }
/// [parameters]
/// J = { value = 0.02, unit = "kg m^2" }
/// b = { value = 0.01, unit = "N m s/rad" }
/// mgl = { value = 0.5, unit = "N m" }
/// lim = { value = 2.0, unit = "N m" }
/// [equations]
/// arm = "J*theta'' + b*theta' + mgl*sin(theta) = saturate(tau, lim)"
/// "#, "pendulum.toml")?;
/// let plant = Plant::of(&model, "tau", &PlantOptions::default())?;
/// assert_eq!(plant.state_names(), ["theta", "theta'"]);
/// assert_eq!(plant.f()[1].to_string(), "-(b*theta' + mgl*sin(theta))/J");
/// assert_eq!(plant.g()[1].to_string(), "1/J");
/// assert_eq!(plant.limits(), (-2.0, 2.0));
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Debug, Clone)]
pub struct Plant {
    pub(crate) symbols: Vec<(String, u8)>,
    pub(crate) input: String,
    pub(crate) f: Vec<Expr>,
    pub(crate) g: Vec<Expr>,
    pub(crate) still: (Vec<Expr>, Vec<Expr>),
    pub(crate) parameters: Vec<(String, f64)>,
    pub(crate) held: Vec<(String, f64)>,
    pub(crate) limits: (f64, f64),
    pub(crate) dead_zone: f64,
    pub(crate) dropped: Vec<Dropped>,
    pub(crate) closed_gaps: Vec<Dropped>,
    pub(crate) input_delay: f64,
    /// The delay of the command as an expression of the parameters.
    pub(crate) late_by: Expr,
    pub(crate) open_gaps: bool,
    pub(crate) sizes: Vec<f64>,
    pub(crate) input_size: f64,
    pub(crate) smooth: Compiled,
    pub(crate) frictionless: Compiled,
    pub(crate) measured: Vec<bool>,
}

pub(crate) fn with_primes(name: &str, primes: u8) -> String {
    Expr::prime(name, primes).to_string()
}

impl Plant {
    /// Names of the states with their primes.
    #[must_use]
    pub fn state_names(&self) -> Vec<String> {
        self.symbols.iter().map(|(n, p)| with_primes(n, *p)).collect()
    }

    /// Names and primes of the states.
    #[must_use]
    pub fn symbols(&self) -> &[(String, u8)] {
        &self.symbols
    }

    /// Position of a state, given with its primes.
    ///
    /// # Errors
    /// [`ControlError::UnknownState`].
    pub fn state(&self, name: &str) -> Result<usize, ControlError> {
        let names = self.state_names();
        let unknown = || ControlError::UnknownState { name: name.to_owned(), known: listed(&names) };
        names.iter().position(|n| n == name).ok_or_else(unknown)
    }

    /// The command's name.
    #[must_use]
    pub fn input_name(&self) -> &str {
        &self.input
    }

    /// f(x), friction smoothed.
    #[must_use]
    pub fn f(&self) -> &[Expr] {
        &self.f
    }

    /// g(x).
    #[must_use]
    pub fn g(&self) -> &[Expr] {
        &self.g
    }

    /// f(x) and g(x) with every `sign` of a state dropped.
    #[must_use]
    pub fn frictionless(&self) -> (&[Expr], &[Expr]) {
        (&self.still.0, &self.still.1)
    }

    /// Names and values (SI) of the parameters.
    #[must_use]
    pub fn parameters(&self) -> &[(String, f64)] {
        &self.parameters
    }

    /// The same plant with other values (SI) of its parameters, in the order of [`parameters`](Self::parameters): what a
    /// law made for this one may meet. Limits, dead zone, sizes and the width of smoothed friction are choices of the
    /// design and stay; the delay of the command does not.
    ///
    /// # Errors
    /// [`ControlError::Size`] for another number of values; [`ControlError::Option`] for one that is not finite, and
    /// where the delay of the command would be negative.
    pub fn with_parameters(&self, values: &[f64]) -> Result<Plant, ControlError> {
        if values.len() != self.parameters.len() {
            let (found, wanted) = (values.len(), self.parameters.len());
            return Err(ControlError::Size { what: "the list of parameters", found, wanted });
        }
        if let Some(((name, _), value)) = self.parameters.iter().zip(values).find(|(_, v)| !v.is_finite()) {
            let what = format!("the parameter `{name}`");
            return Err(ControlError::Option { what, value: *value, wanted: "a finite number" });
        }
        let parameters: Vec<(String, f64)> =
            self.parameters.iter().zip(values).map(|((name, _), value)| (name.clone(), *value)).collect();
        let of = |name: &str, _: u8| parameters.iter().find(|(n, _)| n == name).map(|(_, value)| *value);
        let input_delay = self.late_by.eval(&of).unwrap_or(f64::NAN);
        if !(input_delay >= 0.0 && input_delay.is_finite()) {
            let what = "the delay of the command".to_owned();
            return Err(ControlError::Option {
                what,
                value: input_delay,
                wanted: "a finite time, zero or more",
            });
        }
        Ok(Plant {
            smooth: self.smooth.with_parameters(values),
            frictionless: self.frictionless.with_parameters(values),
            parameters,
            input_delay,
            ..self.clone()
        })
    }

    /// The other inputs and what they are held at.
    #[must_use]
    pub fn held(&self) -> &[(String, f64)] {
        &self.held
    }

    /// The range of the input that the model's `saturate`, `min` and `max` leave; infinite without them.
    #[must_use]
    pub fn limits(&self) -> (f64, f64) {
        self.limits
    }

    /// Half width of the dead zone `deadzone(u, gap)` of the input, zero without one. f and g are those of the plant
    /// behind it; a law adds what it swallows.
    #[must_use]
    pub fn dead_zone(&self) -> f64 {
        self.dead_zone
    }

    /// The command of which so much is left behind the dead zone.
    #[must_use]
    pub fn before_dead_zone(&self, input: f64) -> f64 {
        input + self.dead_zone * if input == 0.0 { 0.0 } else { input.signum() }
    }

    /// How late the command acts, s, where [`PlantOptions::predict_input_delay`] took the delay out of f and g.
    #[must_use]
    pub fn input_delay(&self) -> f64 {
        self.input_delay
    }

    /// What was left out because it depends on the time.
    #[must_use]
    pub fn dropped(&self) -> &[Dropped] {
        &self.dropped
    }

    /// The dead zones of states that the design does without.
    #[must_use]
    pub fn closed_gaps(&self) -> &[Dropped] {
        &self.closed_gaps
    }

    /// Typical sizes of the states.
    #[must_use]
    pub fn sizes(&self) -> &[f64] {
        &self.sizes
    }

    /// Typical size of the input.
    #[must_use]
    pub fn input_size(&self) -> f64 {
        self.input_size
    }

    /// Whether each state is measured itself.
    #[must_use]
    pub fn measured(&self) -> &[bool] {
        &self.measured
    }

    /// Number of states.
    #[must_use]
    pub fn order(&self) -> usize {
        self.symbols.len()
    }

    /// ẋ at a state and an input, friction smoothed.
    #[must_use]
    pub fn rate(&self, x: &[f64], u: f64) -> Vec<f64> {
        rate(&self.smooth, x, u)
    }

    /// ẋ at a state and an input with every `sign` of a state dropped: what it is at rest.
    #[must_use]
    pub fn frictionless_rate(&self, x: &[f64], u: f64) -> Vec<f64> {
        rate(&self.frictionless, x, u)
    }

    /// A = ∂f/∂x + ∂g/∂x u and b = g at a state and an input, friction smoothed; exact derivatives.
    #[must_use]
    pub fn tangent(&self, x: &[f64], u: f64) -> Linear {
        tangent(&self.smooth, x, u)
    }

    /// The same with every `sign` of a state dropped.
    #[must_use]
    pub fn frictionless_tangent(&self, x: &[f64], u: f64) -> Linear {
        tangent(&self.frictionless, x, u)
    }

    pub(crate) fn frictionless_input(&self, x: &[f64], g: &mut [f64]) {
        self.frictionless.eval(x, self.order(), g);
    }
}

fn rate(compiled: &Compiled, x: &[f64], u: f64) -> Vec<f64> {
    let n = x.len();
    let mut both = vec![0.0; 2 * n];
    compiled.eval(x, 0, &mut both);
    (0..n).map(|i| both[i] + both[n + i] * u).collect()
}

fn tangent(compiled: &Compiled, x: &[f64], u: f64) -> Linear {
    let n = x.len();
    let slopes = compiled.jacobian(x);
    let mut g = vec![0.0; n];
    compiled.eval(x, n, &mut g);
    // A state that g does not hold must not spoil A where u is infinite.
    let entry = |i: usize, j: usize| {
        let by_input = slopes[(n + i, j)];
        slopes[(i, j)] + if by_input == 0.0 { 0.0 } else { by_input * u }
    };
    Linear { a: DMatrix::from_fn(n, n, entry), b: DMatrix::from_column_slice(n, 1, &g) }
}

/// The plant with its friction smoothed.
impl greybox_hjb::Plant for Plant {
    fn states(&self) -> usize {
        self.order()
    }

    fn inputs(&self) -> usize {
        1
    }

    fn drift(&self, x: &[f64], f: &mut [f64]) {
        self.smooth.eval(x, 0, f);
    }

    fn input(&self, x: &[f64], g: &mut [f64]) {
        self.smooth.eval(x, self.order(), g);
    }
}
