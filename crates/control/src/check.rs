//! Whether a loop is stable at a set point.

use greybox_hjb::Linear;
use greybox_smc::check::Pole;
use nalgebra::DMatrix;

use crate::compiled::Compiled;
use crate::equilibrium::Equilibrium;
use crate::error::ControlError;
use crate::plant::Plant;
use crate::stability;

/// The loop's tangent at a set point.
#[derive(Debug, Clone, PartialEq)]
pub struct Check {
    /// The set point.
    pub set_point: f64,
    /// Where the plant rests there.
    pub equilibrium: Equilibrium,
    /// Poles of the continuous loop, 1/s, the rightmost first; friction dropped.
    pub poles: Vec<Pole>,
    /// Poles in z of the loop with the command held over the sample time, the largest first; friction dropped.
    pub held_poles: Vec<Pole>,
    /// Largest magnitude of these.
    pub spectral_radius: f64,
    /// Poles of the continuous loop while friction holds the tracked state, 1/s, the rightmost first: those of the other
    /// states. Empty where friction does not hold it, or no other state is left. Where one is in the right half plane, the
    /// machine cannot stay at rest: the loop hunts.
    pub stuck_poles: Vec<Pole>,
}

/// A law under examination.
pub(crate) struct Examined<'a> {
    pub(crate) plant: &'a Plant,
    pub(crate) names: &'a str,
    /// Index of the tracked state.
    pub(crate) tracked: usize,
    pub(crate) dt: f64,
    pub(crate) limits: (f64, f64),
    pub(crate) frictionless: Compiled,
    /// The law with its compensation of friction, where it has one.
    pub(crate) smooth: Option<Compiled>,
}

impl Examined<'_> {
    /// ∂u/∂x, one row.
    pub(crate) fn gain(&self, law: &Compiled, x: &[f64], r: f64) -> DMatrix<f64> {
        let mut at = x.to_vec();
        at.extend([r, 0.0, 0.0]);
        law.jacobian(&at).columns(0, x.len()).into_owned()
    }

    pub(crate) fn check(&self, set_point: f64, at: Equilibrium) -> Result<Check, ControlError> {
        let (low, high) = self.limits;
        let input = self.plant.before_dead_zone(at.input);
        if !(low <= input && input <= high) {
            let tracked = self.names.to_owned();
            return Err(ControlError::Unholdable { tracked, value: set_point, input, low, high });
        }
        if let Some(law) = &self.smooth {
            let plant = self.plant.tangent(&at.state, at.input);
            self.stable(&plant, &self.gain(law, &at.state, set_point), set_point)?;
        }
        let plant = self.plant.frictionless_tangent(&at.state, at.input);
        let gain = self.gain(&self.frictionless, &at.state, set_point);
        let (poles, held_poles) = self.stable(&plant, &gain, set_point)?;
        let spectral_radius = largest(&held_poles);
        let stuck_poles = self.stuck_poles(set_point, &at, (&plant, &gain))?;
        Ok(Check { set_point, equilibrium: at, poles, held_poles, spectral_radius, stuck_poles })
    }

    /// Poles of the loop A while friction holds the tracked state. A friction force λ enters by f and holds the velocity
    /// v = ẋᵢ, so that
    ///
    /// ```text
    /// ẋ = A x + f λ,   v̇ = 0:     ẋ = (I − f eᵀ / fᵥ) A x
    /// ```
    ///
    /// without the tracked state and v. f is what smoothed friction adds to the tangent's column of v.
    fn stuck_poles(
        &self,
        set_point: f64,
        at: &Equilibrium,
        (free, gain): (&Linear, &DMatrix<f64>),
    ) -> Result<Vec<Pole>, ControlError> {
        let symbols = self.plant.symbols();
        let (name, primes) = &symbols[self.tracked];
        let Some(rate) = symbols.iter().position(|(n, p)| n == name && *p == primes + 1) else {
            return Ok(Vec::new());
        };
        let smooth = self.plant.tangent(&at.state, at.input).a;
        let f: Vec<f64> = (0..symbols.len()).map(|i| smooth[(i, rate)] - free.a[(i, rate)]).collect();
        let left: Vec<usize> = (0..f.len()).filter(|i| *i != self.tracked && *i != rate).collect();
        // (Friction brakes.)
        if left.is_empty() || !(f[rate] < 0.0 && f.iter().all(|f| f.is_finite())) {
            return Ok(Vec::new());
        }
        let closed = stability::closed(free, gain);
        let a = DMatrix::from_fn(left.len(), left.len(), |i, j| {
            closed[(left[i], left[j])] - f[left[i]] / f[rate] * closed[(rate, left[j])]
        });
        let sizes: Vec<f64> = left.iter().map(|i| self.plant.sizes()[*i]).collect();
        stability::poles(&a, &sizes).ok_or(ControlError::NoPoles { set_point })
    }

    /// The poles, continuous and in z, if stable.
    fn stable(
        &self,
        plant: &Linear,
        gain: &DMatrix<f64>,
        set_point: f64,
    ) -> Result<(Vec<Pole>, Vec<Pole>), ControlError> {
        let sizes = self.plant.sizes();
        let none = || ControlError::NoPoles { set_point };
        let poles = stability::poles(&stability::closed(plant, gain), sizes).ok_or_else(none)?;
        let size = poles.iter().fold(0.0f64, |size, p| size.max(p.magnitude()));
        // A pole at zero is found anywhere within the rounding errors of the largest one.
        let rounding = 16.0 * poles.len() as f64 * f64::EPSILON * size;
        if let Some(&pole) = poles.first().filter(|p| p.re.is_nan() || p.re >= -rounding) {
            return Err(ControlError::Unstable { set_point, pole });
        }
        let sampled = |dt: f64| {
            let held = stability::held(plant, dt, sizes, self.plant.input_size())?;
            stability::poles(&stability::closed(&held, gain), sizes)
        };
        let mut found = sampled(self.dt).ok_or_else(none)?;
        let radius = largest(&found);
        if radius < 1.0 {
            found.sort_by(|a, b| {
                b.magnitude()
                    .total_cmp(&a.magnitude())
                    .then(b.re.total_cmp(&a.re))
                    .then(b.im.total_cmp(&a.im))
            });
            return Ok((poles, found));
        }
        let shorter = (1..40)
            .map(|k| self.dt * 0.8f64.powi(k))
            .find(|dt| sampled(*dt).is_some_and(|poles| largest(&poles) < 1.0));
        let longest = shorter.map_or(String::new(), |dt| format!(", {dt:.2e} s would do"));
        Err(ControlError::UnstableSampled { set_point, dt: self.dt, radius, longest })
    }
}

/// The largest magnitude.
pub(crate) fn largest(poles: &[Pole]) -> f64 {
    poles.iter().fold(0.0f64, |radius, p| radius.max(p.magnitude()))
}
