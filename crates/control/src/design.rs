//! From a plant to a controller that was checked.

use greybox_model::{Expr, Func};

use crate::check::Examined;
use crate::compiled::Compiled;
use crate::controller::Controller;
use crate::equilibrium::{Equilibrium, equilibrium};
use crate::error::ControlError;
use crate::feedforward::FeedForward;
use crate::methods;
use crate::plant::Plant;

/// The share of the input's size within which a dead zone is compensated in part only.
const NEAR_ZERO: f64 = 1e-2;

/// How the law is found.
#[derive(Debug, Clone, PartialEq)]
pub enum Method {
    /// The linear-quadratic regulator of the tangent at the design point, u = u_e(r) − K (x − x_e(r)).
    Lqr,
    /// The optimal law of a value function of this degree, fitted over a box around the design point
    /// ([`greybox_hjb::design()`]): u = u_e(r) − ½ R⁻¹ g(x)ᵀ ∇V(x − x_e(r)).
    Hjb {
        /// Highest degree of the value function; 2 is the linear regulator.
        degree: u8,
        /// Half widths of the box, one for each state; empty for the plant's sizes. It must hold the largest
        /// deviations from the set point that occur, for beyond it a polynomial means nothing.
        domain: Vec<f64>,
    },
    /// The flat-output sliding-mode law ([`greybox_smc::Law`] with [`greybox_smc::Rate::Model`]) of the tangent at
    /// the design point: ṡ = −η sat(s/φ) holds whatever the nonlinearity.
    Smc {
        /// N − 1 poles on the surface are at −λ, 1/s.
        lambda: f64,
        /// Rate of reaching the surface, in units of the input.
        eta: f64,
        /// Half width of the boundary layer; the pole towards the surface is at −η/φ.
        phi: f64,
    },
}

impl Method {
    /// `lqr`, `hjb` or `smc`.
    #[must_use]
    pub fn name(&self) -> &'static str {
        match self {
            Method::Lqr => "lqr",
            Method::Hjb { .. } => "hjb",
            Method::Smc { .. } => "smc",
        }
    }
}

/// The cost ∫ (Σ qᵢ xᵢ² + r u²) dt of LQR and HJB.
#[derive(Debug, Clone, PartialEq)]
pub struct Weights {
    /// Diagonal of Q, in 1/(unit of the state)².
    pub states: Vec<f64>,
    /// R, in 1/(unit of the input)².
    pub input: f64,
}

impl Weights {
    /// Bryson's rule: one over the square of each size (A. E. Bryson and Y.-C. Ho, *Applied Optimal Control*, 1975,
    /// section 5.2).
    #[must_use]
    pub fn bryson(plant: &Plant) -> Weights {
        let weight = |size: f64| 1.0 / (size * size);
        Weights {
            states: plant.sizes().iter().map(|s| weight(*s)).collect(),
            input: weight(plant.input_size()),
        }
    }
}

/// What a controller is for.
#[derive(Debug, Clone, PartialEq)]
pub struct DesignOptions {
    /// The state to bring to a set point, such as `theta`.
    pub tracked: String,
    /// Set points that will be asked for, SI. The law is designed in the middle of their range and checked at each.
    pub set_points: Vec<f64>,
    /// Sample time: the command is held over it, s.
    pub dt: f64,
    /// The actuator gives ± this at most, beside the limits that the model states.
    pub limit: Option<f64>,
    /// Cost of LQR and HJB; Bryson's rule where there is none.
    pub weights: Option<Weights>,
    /// Whether the gains of an LQR follow the set point: a regulator for each equilibrium of the range, K(r) fitted
    /// as the feed-forward is. Without this (the default) the gains are those of the middle.
    pub scheduled: bool,
    /// Near which equilibrium to look for those of the set points; the origin where there is none.
    pub guess: Option<Equilibrium>,
    /// Whether a sliding-mode law takes Coulomb friction, smoothed, out of the motion. It must then be stable with the
    /// steep slope of the smoothed friction at rest as well, which it is where the actuator's own joint rubs and
    /// often is not where friction is coupled into other coordinates. Without this (the default) what friction leaves
    /// is the error at which the law asks for less than the friction holds.
    pub compensate_friction: bool,
}

impl DesignOptions {
    /// A state to track through set points, with a command held over `dt` s; all else by default.
    #[must_use]
    pub fn new(tracked: &str, set_points: &[f64], dt: f64) -> DesignOptions {
        DesignOptions {
            tracked: tracked.to_owned(),
            set_points: set_points.to_vec(),
            dt,
            limit: None,
            weights: None,
            scheduled: false,
            guess: None,
            compensate_friction: false,
        }
    }
}

/// Designs a controller and checks it.
///
/// The design point is the equilibrium in the middle of the range of the set points. At it and at every set point the
/// tangent of the loop, friction dropped, must have its poles in the left half plane, and with the command held over
/// `dt` in the unit circle; the input that holds the plant there must be within the limits. That is linear and local:
/// simulate the steps that will be made ([`ClosedLoop`](crate::ClosedLoop)).
///
/// ```
/// use greybox_control::{DesignOptions, Method, Plant, PlantOptions, design};
/// # let model = greybox_model::Model::from_toml(r#"
/// # [inputs]
/// # tau = { unit = "N m" }
/// # [states]
/// # theta = { unit = "rad" }
/// # [parameters]
/// # J = { value = 0.02, unit = "kg m^2" }
/// # mgl = { value = 0.5, unit = "N m" }
/// # [equations]
/// # arm = "J*theta'' + mgl*sin(theta) = tau"
/// # "#, "pendulum.toml")?;
/// let plant = Plant::of(&model, "tau", &PlantOptions::default())?;
/// let law = design(&plant, &Method::Lqr, &DesignOptions::new("theta", &[0.0, 1.0], 1e-3))?;
/// // At rest at the set point the law gives what holds the arm there.
/// assert!((law.command(&[1.0, 0.0], 1.0) - 0.5 * 1f64.sin()).abs() < 1e-6);
/// assert!(law.checks().iter().all(|c| c.spectral_radius < 1.0));
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
///
/// # Errors
/// [`ControlError`]: options that make no sense, set points without an equilibrium or beyond the actuator, a tangent
/// that no feedback stabilises, a loop that is unstable at a set point or when sampled.
pub fn design(plant: &Plant, method: &Method, options: &DesignOptions) -> Result<Controller, ControlError> {
    let n = plant.order();
    let tracked = plant.state(&options.tracked)?;
    let option =
        |what: &str, value: f64, wanted| ControlError::Option { what: what.to_owned(), value, wanted };
    if !(options.dt > 0.0 && options.dt.is_finite()) {
        return Err(option("the sample time", options.dt, "a positive finite number of seconds"));
    }
    if options.set_points.is_empty() {
        return Err(option("the number of set points", 0.0, "one or more"));
    }
    if let Some(bad) = options.set_points.iter().find(|r| !r.is_finite()) {
        return Err(option("a set point", *bad, "a finite number"));
    }
    let (mut low, mut high) = plant.limits();
    if let Some(limit) = options.limit {
        if limit.is_nan() || limit <= 0.0 {
            return Err(option("the limit of the input", limit, "a positive number"));
        }
        (low, high) = (low.max(-limit), high.min(limit));
    }
    let weights = options.weights.clone().unwrap_or_else(|| Weights::bryson(plant));
    if weights.states.len() != n {
        return Err(ControlError::Size {
            what: "the weights of the states",
            found: weights.states.len(),
            wanted: n,
        });
    }
    let reference = free_name(plant);
    let least = options.set_points.iter().copied().fold(f64::INFINITY, f64::min);
    let most = options.set_points.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    let guess = options.guess.clone().unwrap_or_else(|| Equilibrium::origin(n));
    let feed_forward = FeedForward::new(plant, tracked, (least, most), &guess, &reference)?;
    let center = 0.5 * (least + most);
    let middle = feed_forward.equilibria[feed_forward.equilibria.len() / 2].clone();
    let design = methods::Design {
        plant,
        tangent: plant.frictionless_tangent(&middle.state, middle.input),
        at: &middle,
        set_point: center,
        dt: options.dt,
        weights: &weights,
        feed_forward: &feed_forward,
    };
    let made = match method {
        Method::Lqr => design.lqr(options.scheduled)?,
        Method::Hjb { degree, domain } => design.hjb(*degree, domain)?,
        Method::Smc { lambda, eta, phi } => design.smc(*lambda, *eta, *phi, options.compensate_friction)?,
    };
    let mut variables = plant.symbols().to_vec();
    variables.push((reference.clone(), 0));
    let compile = |e: &Expr| Compiled::new(std::slice::from_ref(e), &variables, plant.parameters());
    let limited = limited(&made.law, plant, low, high);
    let examined = Examined {
        plant,
        names: &options.tracked,
        dt: options.dt,
        limits: (low, high),
        frictionless: compile(&made.frictionless)?,
        smooth: (made.law != made.frictionless).then(|| compile(&made.law)).transpose()?,
    };
    let design_point = examined.check(center, middle)?;
    let gains = examined.gain(&examined.frictionless, &design_point.equilibrium.state, center);
    let mut checks = Vec::with_capacity(options.set_points.len());
    for &r in &options.set_points {
        let share = if most > least { (r - least) / (most - least) } else { 0.0 };
        let near = (share * (feed_forward.equilibria.len() - 1) as f64).round() as usize;
        let at = equilibrium(plant, tracked, r, &feed_forward.equilibria[near])?;
        checks.push(examined.check(r, at)?);
    }
    Ok(Controller {
        compiled: compile(&limited)?,
        plant: plant.clone(),
        method: method.clone(),
        tracked,
        reference,
        dt: options.dt,
        limits: (low, high),
        weights,
        design_point,
        checks,
        gains: gains.iter().map(|k| -k).collect(),
        verification: made.verification,
        unlimited: made.law,
        law: vec![limited],
        feed_forward,
    })
}

/// `r`, or a name like it that the model does not use.
fn free_name(plant: &Plant) -> String {
    let taken = |name: &str| {
        name == plant.input_name()
            || plant.symbols().iter().any(|(n, _)| n == name)
            || plant.parameters().iter().any(|(n, _)| n == name)
            || plant.held().iter().any(|(n, _)| n == name)
    };
    let mut name = "r".to_owned();
    while taken(&name) {
        name.push_str("_set");
    }
    name
}

/// The command within its limits, with what a dead zone swallows added. Near zero, within δ = [`NEAR_ZERO`] of the
/// input's size, the addition is linear: it never exceeds what is swallowed, and does not chatter.
fn limited(law: &Expr, plant: &Plant, low: f64, high: f64) -> Expr {
    let mut u = law.clone();
    if plant.dead_zone() > 0.0 {
        let steep = Expr::Num(plant.dead_zone() / (NEAR_ZERO * plant.input_size())) * law.clone();
        u = u + Expr::call(Func::Saturate, vec![steep, Expr::Num(plant.dead_zone())]);
    }
    if low.is_infinite() && high.is_infinite() {
        return u;
    }
    if low == -high {
        return Expr::call(Func::Saturate, vec![u, Expr::Num(high)]);
    }
    if low.is_finite() {
        u = Expr::call(Func::Max, vec![u, Expr::Num(low)]);
    }
    if high.is_finite() {
        u = Expr::call(Func::Min, vec![u, Expr::Num(high)]);
    }
    u
}
