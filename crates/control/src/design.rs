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
use crate::specification::{DesignOptions, Method, Weights};

/// The share of the input's size within which a dead zone is compensated in part only.
const NEAR_ZERO: f64 = 1e-2;

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
    let reference = free_name(plant, "r", &[]);
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
        tracked: &options.tracked,
        limits: (low, high),
        target: &feed_forward.target(plant, tracked, &reference, options.trajectories)?,
    };
    let made = match method {
        Method::Lqr => design.lqr(options.scheduled)?,
        Method::Hjb { degree, domain, bounded } => design.hjb(*degree, domain, *bounded)?,
        Method::Smc { lambda, eta, phi } => design.smc(*lambda, *eta, *phi, options.compensate_friction)?,
    };
    let mut variables = plant.symbols().to_vec();
    variables.extend((0..3).map(|primes| (reference.clone(), primes)));
    let compile = |e: &Expr| Compiled::new(std::slice::from_ref(e), &variables, plant.parameters());
    let limited = limited(&made.law, plant, low, high);
    let examined = Examined {
        plant,
        names: &options.tracked,
        tracked,
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
        frictionless: examined.frictionless,
        plant: plant.clone(),
        method: method.clone(),
        tracked,
        reference,
        trajectories: options.trajectories,
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

/// `name`, or one like it that neither the model nor `others` use.
pub(crate) fn free_name(plant: &Plant, name: &str, others: &[&str]) -> String {
    let taken = |name: &str| {
        others.contains(&name)
            || name == plant.input_name()
            || plant.symbols().iter().any(|(n, _)| n == name)
            || plant.parameters().iter().any(|(n, _)| n == name)
            || plant.held().iter().any(|(n, _)| n == name)
    };
    let mut name = name.to_owned();
    while taken(&name) {
        name.push_str("_set");
    }
    name
}

/// The command within its limits, with what a dead zone swallows added. Near zero, within δ = [`NEAR_ZERO`] of the
/// input's size, the addition is linear: it never exceeds what is swallowed, and does not chatter.
pub(crate) fn limited(law: &Expr, plant: &Plant, low: f64, high: f64) -> Expr {
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
