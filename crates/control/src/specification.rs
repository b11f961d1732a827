//! What a design is asked for: the method, the cost, the set points.

use crate::equilibrium::Equilibrium;
use crate::plant::Plant;

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
        /// Whether the limits of the input are in the cost ([`greybox_hjb::InputRange`]), so that the law stays within
        /// them by itself and knows that braking takes time. Both limits must be finite. The range is that between the
        /// limits, less a dead zone, around u_e(r): with its middle m, half h and T = (u_e(r) − m)/h the law is
        ///
        /// ```text
        /// u = m + h tanh(atanh T − R⁻¹gᵀ∇V / (2 h (1 − T²)))
        /// ```
        ///
        /// which uses all of the range on both sides, rests at u_e(r), and near there is the law without limits. V is
        /// that of the design point. Without this (the default) the limits clip the law.
        bounded: bool,
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
    /// Whether the reference moves: the law then reads its first two derivatives too ([`Target`](crate::Target)), and
    /// follows a smooth [`Trajectory`](crate::Trajectory) without the lag of one that takes every value for a set point.
    pub trajectories: bool,
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
            trajectories: false,
        }
    }
}
