//! The virtual rotary flexible link as a plant of the laws, and how well a square wave is followed. Shared by tests
//! and the example `link`.

use greybox_simulate::rigs::{RotaryFlexibleLink, Sampling, square_wave};
use greybox_smc::{Command, Equilibrium, EquilibriumSolver, Fault, SmcError, Tangent, smooth_sign};

/// Sample time, s.
pub(crate) const DT: f64 = 5e-4;

/// What the amplifier gives, V.
pub(crate) const LIMIT: f64 = 10.0;

/// Width of the smoothed friction in the laws, rad/s.
const SMOOTHING: f64 = 0.05;

/// f(x) of the rig, its friction smoothed.
pub(crate) fn f(rig: &RotaryFlexibleLink, x: [f64; 4]) -> [f64; 4] {
    rig.drift(x, smooth_sign(x[2], SMOOTHING))
}

/// The equilibrium with a given θ and the tangent of the whole rig there, without Coulomb friction.
pub(crate) fn rest(rig: &RotaryFlexibleLink, theta: f64) -> Result<(Equilibrium<4>, Tangent<4>), SmcError> {
    let (rig, g) = (rig.without_friction(), rig.input());
    let model = |x: &[f64; 4], u: f64| {
        let f = f(&rig, *x);
        std::array::from_fn(|i| f[i] + g[i] * u)
    };
    let solver = EquilibriumSolver::new(0)?;
    let equilibrium = solver.solve(model, theta, &Equilibrium::ORIGIN)?;
    Ok((equilibrium, solver.tangent(model, &equilibrium)?))
}

/// How well a square wave was followed: the worst over the full steps.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Figures {
    /// From the step until θ stays within 2 % of the step, s.
    pub(crate) settling: f64,
    /// Beyond the wanted angle, % of the step.
    pub(crate) overshoot: f64,
    /// |θ − θ_d| at the end of a half period, degrees.
    pub(crate) last_error: f64,
    /// Largest |α|, degrees.
    pub(crate) deflection: f64,
    /// Largest |V| applied.
    pub(crate) voltage: f64,
    /// Largest |V| wanted.
    pub(crate) unlimited: f64,
    /// Largest |s|, rad/s.
    pub(crate) surface: f64,
}

/// Four half periods of a square wave of 0.25 Hz between ±`amplitude` (rad), from rest at zero; `law` gets the true
/// state and θ_d. The first half period, a step of half the size, is not judged.
pub(crate) fn follow(
    rig: &RotaryFlexibleLink,
    amplitude: f64,
    mut law: impl FnMut([f64; 4], f64) -> Result<Command, Fault>,
) -> Result<Figures, Box<dyn std::error::Error>> {
    let (frequency, half) = (0.25, 4000);
    let mut figures = Figures::default();
    let mut x = [0.0; 4];
    let mut settled_at = 0;
    for k in 0..4 * half {
        let wanted = square_wave(amplitude, frequency, (k as f64 + 0.5) * DT);
        let command = law(x, wanted)?;
        figures.voltage = figures.voltage.max(command.u.abs());
        figures.unlimited = figures.unlimited.max(command.unlimited.abs());
        figures.surface = figures.surface.max(command.surface.abs());
        figures.deflection = figures.deflection.max(x[1].to_degrees().abs());
        let sampling = Sampling { dt: DT, substeps: 2 };
        match rig.run(sampling, x, 2, |_, _| command.u) {
            Ok(run) => x = run.states[1],
            Err(_) => return Err(format!("ran away after {:.2} s", k as f64 * DT).into()),
        }
        if k < half {
            continue;
        }
        let step = 2.0 * amplitude;
        let past = (x[0] - wanted) * wanted.signum();
        figures.overshoot = figures.overshoot.max(100.0 * past / step);
        if past.abs() > 0.02 * step {
            settled_at = k % half + 1;
        }
        if k % half == half - 1 {
            figures.settling = figures.settling.max(settled_at as f64 * DT);
            figures.last_error = figures.last_error.max(past.to_degrees().abs());
            settled_at = 0;
        }
    }
    Ok(figures)
}
