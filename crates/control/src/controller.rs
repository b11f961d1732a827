//! A controller and what is known about it.

use greybox_hjb::Verification;
use greybox_model::Expr;

use crate::check::Check;
use crate::compiled::Compiled;
use crate::feedforward::FeedForward;
use crate::plant::Plant;
use crate::specification::{Method, Weights};

/// A law that was checked.
#[derive(Debug, Clone)]
pub struct Controller {
    pub(crate) plant: Plant,
    pub(crate) method: Method,
    pub(crate) tracked: usize,
    pub(crate) reference: String,
    pub(crate) trajectories: bool,
    pub(crate) dt: f64,
    pub(crate) limits: (f64, f64),
    pub(crate) weights: Weights,
    pub(crate) design_point: Check,
    pub(crate) checks: Vec<Check>,
    pub(crate) gains: Vec<f64>,
    pub(crate) feed_forward: FeedForward,
    pub(crate) verification: Option<Verification>,
    pub(crate) unlimited: Expr,
    pub(crate) law: Vec<Expr>,
    pub(crate) compiled: Compiled,
    /// The law without limits and without its compensation of friction.
    pub(crate) frictionless: Compiled,
}

impl Controller {
    /// The plant it was designed for.
    #[must_use]
    pub fn plant(&self) -> &Plant {
        &self.plant
    }

    /// How it was found.
    #[must_use]
    pub fn method(&self) -> &Method {
        &self.method
    }

    /// Index of the tracked state.
    #[must_use]
    pub fn tracked(&self) -> usize {
        self.tracked
    }

    /// The name of the set point in the law: `r`, unless the model has a name like that.
    #[must_use]
    pub fn reference(&self) -> &str {
        &self.reference
    }

    /// Sample time, s.
    #[must_use]
    pub fn dt(&self) -> f64 {
        self.dt
    }

    /// Range of the command.
    #[must_use]
    pub fn limits(&self) -> (f64, f64) {
        self.limits
    }

    /// The cost of LQR and HJB.
    #[must_use]
    pub fn weights(&self) -> &Weights {
        &self.weights
    }

    /// K of u = u_e − K (x − x_e), which the law is near its design point, friction dropped.
    #[must_use]
    pub fn gains(&self) -> &[f64] {
        &self.gains
    }

    /// The loop in the middle of the range.
    #[must_use]
    pub fn design_point(&self) -> &Check {
        &self.design_point
    }

    /// The loop at each set point, in the order given.
    #[must_use]
    pub fn checks(&self) -> &[Check] {
        &self.checks
    }

    /// The equilibrium as a function of the set point, with the errors of its fit.
    #[must_use]
    pub fn feed_forward(&self) -> &FeedForward {
        &self.feed_forward
    }

    /// What the value function of an HJB law was found to do, without limits unless the law is bounded; its numbers are
    /// those of states counted in half widths of the domain.
    #[must_use]
    pub fn verification(&self) -> Option<&Verification> {
        self.verification.as_ref()
    }

    /// The command, within the limits, as an expression of the states, the set point ([`reference`](Self::reference)), of a
    /// law for [`trajectories`](Self::trajectories) its first two derivatives, and the plant's parameters.
    #[must_use]
    pub fn law(&self) -> &[Expr] {
        &self.law
    }

    /// The command without limits, behind the dead zone; a bounded law ([`Method::Hjb`]) is within them.
    #[must_use]
    pub fn unlimited(&self) -> &Expr {
        &self.unlimited
    }

    /// Whether the law is made for a reference that moves: whether it reads r′ and r″
    /// ([`DesignOptions::trajectories`](crate::DesignOptions)).
    #[must_use]
    pub fn trajectories(&self) -> bool {
        self.trajectories
    }

    /// The command, within the limits, at a state (in the plant's order) for a set point. Not a number where the
    /// state has another length, or where the law divides by zero: the caller must then do what is safe.
    #[must_use]
    pub fn command(&self, x: &[f64], r: f64) -> f64 {
        self.command_along(x, &[r, 0.0, 0.0])
    }

    /// The same for a reference r that moves, with r′ and r″. A law that is made for set points reads r alone.
    #[must_use]
    pub fn command_along(&self, x: &[f64], reference: &[f64; 3]) -> f64 {
        let finite = |values: &[f64]| values.iter().all(|v| v.is_finite());
        if x.len() != self.plant.order() || !finite(x) || !finite(reference) {
            return f64::NAN;
        }
        let mut at = x.to_vec();
        at.extend(reference);
        let mut u = [f64::NAN];
        self.compiled.eval(&at, 0, &mut u);
        // The comparisons of a limit would make a number of what is none.
        if u[0].is_nan() { f64::NAN } else { u[0].max(self.limits.0).min(self.limits.1) }
    }
}
