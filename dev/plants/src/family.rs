//! What is known of the families: how a machine is drawn, what its coordinates are, where an effect makes sense.

use rand::RngExt;
use rand_pcg::Pcg64Mcg;

use crate::kind::Kind;
use crate::machine::Family;

impl Family {
    /// The coordinates that nothing pulls back.
    pub fn drifting(self) -> &'static [usize] {
        match self {
            Family::TwoMass => &[0, 1],
            Family::Servo | Family::FlexibleLink | Family::DcMotor | Family::Table => &[0],
            _ => &[],
        }
    }

    /// Whether its coordinates are angles.
    pub fn rotary(self) -> bool {
        !matches!(self, Family::Oscillator | Family::QuarterCar | Family::Duffing | Family::Table)
    }

    /// A machine of the family whose resonance or bandwidth is at `omega`, rad/s, moving by about `size`.
    pub fn draw(self, omega: f64, size: f64, rng: &mut Pcg64Mcg) -> Vec<f64> {
        let mut u = |low: f64, high: f64| rng.random_range(low..high);
        match self {
            Family::Servo => {
                let j = 0.002 * 10f64.powf(u(0.0, 1.0));
                vec![j, j * omega * u(0.15, 0.5), u(0.05, 0.6)]
            }
            Family::Oscillator => {
                let m = 0.5 * 10f64.powf(u(0.0, 1.3));
                vec![m, 2.0 * u(0.03, 0.25) * omega * m, m * omega * omega]
            }
            Family::Pendulum => {
                let j = 0.02 * 10f64.powf(u(0.0, 1.3));
                vec![j, 2.0 * u(0.04, 0.2) * omega * j, j * omega * omega]
            }
            Family::TwoMass => {
                let j1 = 0.002 * 10f64.powf(u(0.0, 1.0));
                let j2 = j1 * u(0.5, 3.0);
                let ks = omega * omega * j1 * j2 / (j1 + j2);
                let cs = 2.0 * u(0.03, 0.1) * ks / omega;
                vec![j1, j1 * omega * u(0.06, 0.2), ks, cs, j2, j2 * omega * u(0.05, 0.15), u(0.05, 0.5)]
            }
            Family::FlexibleLink => {
                let j = 0.002 * 10f64.powf(u(0.0, 0.7));
                let jl = j * u(0.4, 1.5);
                let ks = omega * omega * j * jl / (j + jl);
                vec![j, j * omega * u(0.1, 0.3), ks, jl, 2.0 * u(0.03, 0.1) * ks / omega, u(0.05, 0.6)]
            }
            Family::DcMotor => {
                let (kt, r) = (u(0.03, 0.2), u(0.5, 4.0));
                // Mechanical time constant J R/kt² and electrical one L/R, both in terms of 1/ω.
                let j = u(1.5, 4.0) / omega * kt * kt / r;
                vec![j, u(0.2, 0.6) * kt * kt / r, kt, u(0.15, 0.4) / omega * r, r]
            }
            Family::QuarterCar => {
                let ms = u(2.0, 400.0);
                let ks = ms * omega * omega;
                vec![ms, 2.0 * u(0.15, 0.35) * omega * ms, ks, ms * u(0.15, 0.3), ks * u(3.0, 6.0)]
            }
            Family::Duffing => {
                let m = 0.5 * 10f64.powf(u(0.0, 1.3));
                let k = m * omega * omega;
                vec![m, 2.0 * u(0.05, 0.2) * omega * m, k, k * u(0.15, 0.5) / (size * size)]
            }
            Family::Table => {
                let (m1, m2) = (u(1.0, 20.0), u(1.0, 20.0));
                let k2 = m2 * omega * omega * u(0.5, 1.5);
                vec![m1, m1 * omega * u(0.15, 0.4), m2, 2.0 * u(0.04, 0.2) * omega * m2, k2, u(2.0, 40.0)]
            }
        }
    }

    /// The damper along a place, by its parameter.
    pub fn damper(self, place: usize) -> Option<usize> {
        match (self, place) {
            (Family::TwoMass, 0) => Some(1),
            (Family::TwoMass, 1) => Some(5),
            (Family::Table, 0) => Some(1),
            (Family::Table, 1) => Some(3),
            (Family::QuarterCar, _) | (Family::FlexibleLink, 1) | (Family::TwoMass, _) => None,
            _ => Some(1),
        }
    }

    /// Whether an input acts on the equation of the place's own coordinate.
    pub fn driven(self, place: usize) -> bool {
        !matches!(
            (self, place),
            (Family::TwoMass, 1 | 2) | (Family::FlexibleLink, 1) | (Family::QuarterCar, _)
        )
    }
}

/// Places (inputs, channels) at which a kind makes sense in a family and can be told.
pub fn places(kind: Kind, family: Family) -> Vec<usize> {
    use Family::*;
    use Kind::*;
    let places: &[usize] = match (kind, family) {
        (ViscousFriction, FlexibleLink) => &[0],
        (ViscousFriction, QuarterCar) => &[],
        (ViscousFriction, TwoMass | Table) => &[0, 1],
        (ViscousFriction, _) => &[0],
        (
            CoulombFriction
            | AsymmetricCoulombFriction
            | StribeckFriction
            | PreslidingFriction
            | QuadraticDrag,
            TwoMass | Table,
        ) => &[0, 1],
        (StribeckFriction | PreslidingFriction, QuarterCar) => &[],
        (CoulombFriction, FlexibleLink) => &[0, 1],
        (
            CoulombFriction
            | AsymmetricCoulombFriction
            | StribeckFriction
            | PreslidingFriction
            | QuadraticDrag,
            _,
        ) => &[0],
        (LoadDependentFriction, Servo | DcMotor | FlexibleLink | Table) => &[0],
        (LoadDependentFriction, TwoMass) => &[1],
        (LinearStiffness, Servo | DcMotor | FlexibleLink | Table) => &[0],
        (LinearStiffness, TwoMass) => &[0, 1],
        (QuadraticStiffness, Oscillator | Duffing | QuarterCar) => &[0],
        (QuadraticStiffness | CubicStiffness, FlexibleLink | Table) => &[1],
        (QuadraticStiffness | CubicStiffness, TwoMass) => &[2],
        (CubicStiffness, Oscillator | QuarterCar | Servo) => &[0],
        (DeadZone, Oscillator | QuarterCar) => &[0],
        (DeadZone, TwoMass) => &[2],
        (DeadZone, FlexibleLink | Table) => &[1],
        (EndStop, Oscillator | Duffing | Pendulum | QuarterCar | Servo) => &[0],
        (EndStop, FlexibleLink) => &[1],
        (EndStop, Table) => &[0, 1],
        (BoucWenHysteresis, Oscillator | Duffing | QuarterCar) => &[0],
        (BoucWenHysteresis, Table | FlexibleLink) => &[1],
        (InputSaturation | InputDeadZone, QuarterCar) => &[],
        (InputSaturation | InputDeadZone, _) => &[0],
        (InputDelay, Table) => &[0, 1],
        (InputDelay, _) => &[0],
        (ActuatorLag, DcMotor | QuarterCar) => &[],
        (ActuatorLag, Table) => &[0, 1],
        (ActuatorLag, _) => &[0],
        (InputOffset, QuarterCar) => &[],
        (InputOffset, Table) => &[0, 1],
        (InputOffset, _) => &[0],
        (Gravity, Servo | DcMotor | FlexibleLink) => &[0],
        (Gravity, TwoMass) => &[0, 1],
        (Cogging, Servo | DcMotor | FlexibleLink | Pendulum | TwoMass | Table) => &[0],
        (PositionDependentInertia, Servo | DcMotor | Pendulum | FlexibleLink) => &[0],
        (PositionDependentInertia, TwoMass) => &[1],
        (Coupling, Table) => &[0, 1],
        (UnmodeledResonance, Servo | Oscillator | Duffing | DcMotor) => &[0],
        (UnmodeledResonance, Table) => &[0, 1],
        (FeedbackDelay, Oscillator | Duffing) => &[0],
        (FeedbackDelay, Table) => &[1],
        (ConstantOffset | PeriodicDisturbance | StepDisturbance, TwoMass | Table) => &[0, 1],
        (ConstantOffset | PeriodicDisturbance | StepDisturbance, QuarterCar) => &[1],
        (ConstantOffset | PeriodicDisturbance | StepDisturbance, _) => &[0],
        (ParameterDrift, _) => &[0],
        (SensorOffset, Oscillator | Duffing | Pendulum | QuarterCar) => &[0],
        (SensorOffset, FlexibleLink | Table) => &[1],
        (SensorDelay, TwoMass | Table | FlexibleLink | QuarterCar) => &[0, 1],
        (SensorDelay, _) => &[0],
        (DisplacementDamping, Oscillator | Pendulum | Duffing) => &[0],
        (DisplacementDamping, Table) => &[1],
        (SineOfPower, Oscillator | Duffing) => &[0],
        (SineOfPower, Table) => &[1],
        (BreathingQuadratic, Oscillator | Duffing) => &[0],
        (BreathingQuadratic, Table) => &[1],
        (PositionFriction, Oscillator | Duffing | Pendulum) => &[0],
        (PositionFriction, Table) => &[1],
        (ProductCoupling, Table) => &[1],
        (TiringActuator, Oscillator | Pendulum | Duffing | Servo) => &[0],
        (QuinticStiffness, Oscillator) => &[0],
        (QuinticStiffness, Table) => &[1],
        (ParametricExcitation, Oscillator | Duffing) => &[0],
        (ParametricExcitation, Table) => &[1],
        (EddyBrake | PowerDrag, Oscillator | Duffing | Pendulum | Servo) => &[0],
        (EddyBrake | PowerDrag, Table) => &[1],
        (MaxwellElement, Oscillator | Duffing) => &[0],
        (MaxwellElement, Table | FlexibleLink) => &[1],
        (AgeingFriction, Oscillator | Pendulum | Servo) => &[0],
        (OneWayDamper, Oscillator | Duffing | QuarterCar) => &[0],
        (OneWayDamper, Table) => &[1],
        (LockingSpring, Oscillator | QuarterCar) => &[0],
        (LockingSpring, Table | FlexibleLink) => &[1],
        _ => &[],
    };
    places.to_vec()
}
