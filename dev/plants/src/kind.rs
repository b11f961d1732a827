//! What a case may leave out: names, families and parameters of every effect.

/// An effect left out of the nominal model: those of the library, and some outside it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Kind {
    /// `b*d'`.
    ViscousFriction,
    /// `fc*sign(d')`; it holds what is at rest.
    CoulombFriction,
    /// Coulomb friction of level `fcp` forwards and `fcn` backwards.
    AsymmetricCoulombFriction,
    /// `(fc + (fs - fc)*exp(-(d'/vs)^2))*sign(d')`.
    StribeckFriction,
    /// Friction with an elastic bristle of stiffness `s0` and level `fc`.
    PreslidingFriction,
    /// `cd*d'*abs(d')`.
    QuadraticDrag,
    /// `mul*abs(load)*sign(d')`.
    LoadDependentFriction,
    /// `kg*d`.
    LinearStiffness,
    /// `kq2*d^2`.
    QuadraticStiffness,
    /// `k3*d^3`.
    CubicStiffness,
    /// The family's spring acts beyond a half gap.
    DeadZone,
    /// `kst*max(d - xst, 0)`.
    EndStop,
    /// `kh*z` with the state `z` of Bouc and Wen.
    BoucWenHysteresis,
    /// The input is held within `±usat`.
    InputSaturation,
    /// The input acts beyond `±udz`.
    InputDeadZone,
    /// The input acts `tau` later.
    InputDelay,
    /// The input acts through a lag of first order.
    ActuatorLag,
    /// `u + uo` for `u`.
    InputOffset,
    /// `mgl*sin(d)`.
    Gravity,
    /// `acg*sin(ncg*d + pcg)`.
    Cogging,
    /// `je*cos(n*d)` more inertia, with the force of its change.
    PositionDependentInertia,
    /// A spring, a damper or an inertia from the other coordinate.
    Coupling,
    /// A second mass on a spring and a damper.
    UnmodeledResonance,
    /// The family's spring acts `tau_f` late.
    FeedbackDelay,
    /// `f0`.
    ConstantOffset,
    /// `ad*sin(2*pi*fd*t + pd)`.
    PeriodicDisturbance,
    /// `fst` from the time `t0`.
    StepDisturbance,
    /// A parameter of the machine that changes with time.
    ParameterDrift,
    /// `y + so` for `y`.
    SensorOffset,
    /// The sensor shows what was `tsd` before.
    SensorDelay,
    /// `cx*d^2*d'`: damping that grows with the displacement.
    DisplacementDamping,
    /// `asx*sin(nsx*d*d')`.
    SineOfPower,
    /// `kqt*(1 + cos(2*pi*fq*t))*d^2`: a quadratic spring that breathes.
    BreathingQuadratic,
    /// `fqq*d^2*sign(d')`: friction that grows with the square of the position.
    PositionFriction,
    /// `kxx*q1*q2` in the equation of `q1`.
    ProductCoupling,
    /// `u/(1 + bf*s)` for `u`, `tf*s' = abs(u) - s`: an actuator that tires.
    TiringActuator,
    /// `k5*d^5`.
    QuinticStiffness,
    /// `ap*cos(2*pi*fp*t)*d`: a spring that is pumped.
    ParametricExcitation,
    /// `bv*d'/(1 + (d'/vb)^2)`: an eddy-current brake.
    EddyBrake,
    /// `km*(d - s)`, `tm*s' = d - s`: a spring and a damper in series.
    MaxwellElement,
    /// `fw*sign(d')/(1 + s/vw)`, `tw*s' = abs(d') - s`: friction that grows at rest.
    AgeingFriction,
    /// `bo*max(d', 0)`: a damper that acts one way.
    OneWayDamper,
    /// `cp*abs(d')^1.5*sign(d')`: a drag between viscous and quadratic.
    PowerDrag,
    /// `ke*sinh(d/le)`: a spring that locks.
    LockingSpring,
}

use Kind::*;

/// The kinds of the library.
pub const LIBRARY: [Kind; 30] = [
    ViscousFriction,
    CoulombFriction,
    AsymmetricCoulombFriction,
    StribeckFriction,
    PreslidingFriction,
    QuadraticDrag,
    LoadDependentFriction,
    LinearStiffness,
    QuadraticStiffness,
    CubicStiffness,
    DeadZone,
    EndStop,
    BoucWenHysteresis,
    InputSaturation,
    InputDeadZone,
    InputDelay,
    ActuatorLag,
    InputOffset,
    Gravity,
    Cogging,
    PositionDependentInertia,
    Coupling,
    UnmodeledResonance,
    FeedbackDelay,
    ConstantOffset,
    PeriodicDisturbance,
    StepDisturbance,
    ParameterDrift,
    SensorOffset,
    SensorDelay,
];

/// Effects that the library has no name for.
pub const OUTSIDE: [Kind; 14] = [
    DisplacementDamping,
    SineOfPower,
    BreathingQuadratic,
    PositionFriction,
    ProductCoupling,
    TiringActuator,
    QuinticStiffness,
    ParametricExcitation,
    EddyBrake,
    MaxwellElement,
    AgeingFriction,
    OneWayDamper,
    PowerDrag,
    LockingSpring,
];

impl Kind {
    /// As in a report.
    pub fn name(self) -> &'static str {
        match self {
            ViscousFriction => "viscous_friction",
            CoulombFriction => "coulomb_friction",
            AsymmetricCoulombFriction => "asymmetric_coulomb_friction",
            StribeckFriction => "stribeck_friction",
            PreslidingFriction => "presliding_friction",
            QuadraticDrag => "quadratic_drag",
            LoadDependentFriction => "load_dependent_friction",
            LinearStiffness => "linear_stiffness",
            QuadraticStiffness => "quadratic_stiffness",
            CubicStiffness => "cubic_stiffness",
            DeadZone => "dead_zone",
            EndStop => "end_stop",
            BoucWenHysteresis => "bouc_wen_hysteresis",
            InputSaturation => "input_saturation",
            InputDeadZone => "input_dead_zone",
            InputDelay => "input_delay",
            ActuatorLag => "actuator_lag",
            InputOffset => "input_offset",
            Gravity => "gravity",
            Cogging => "cogging",
            PositionDependentInertia => "position_dependent_inertia",
            Coupling => "coupling",
            UnmodeledResonance => "unmodeled_resonance",
            FeedbackDelay => "feedback_delay",
            ConstantOffset => "constant_offset",
            PeriodicDisturbance => "periodic_disturbance",
            StepDisturbance => "step_disturbance",
            ParameterDrift => "parameter_drift",
            SensorOffset => "sensor_offset",
            SensorDelay => "sensor_delay",
            DisplacementDamping => "outside_displacement_damping",
            SineOfPower => "outside_sine_of_power",
            BreathingQuadratic => "outside_breathing_quadratic",
            PositionFriction => "outside_position_friction",
            ProductCoupling => "outside_product_coupling",
            TiringActuator => "outside_tiring_actuator",
            QuinticStiffness => "outside_quintic_stiffness",
            ParametricExcitation => "outside_parametric_excitation",
            EddyBrake => "outside_eddy_brake",
            MaxwellElement => "outside_maxwell_element",
            AgeingFriction => "outside_ageing_friction",
            OneWayDamper => "outside_one_way_damper",
            PowerDrag => "outside_power_drag",
            LockingSpring => "outside_locking_spring",
        }
    }

    /// Family of the kind of that name; `None` for a name that is not in the library.
    pub fn family_of(name: &str) -> Option<&'static str> {
        LIBRARY.iter().find(|k| k.name() == name).map(|k| k.family())
    }

    /// The family.
    pub fn family(self) -> &'static str {
        match self {
            ViscousFriction
            | CoulombFriction
            | AsymmetricCoulombFriction
            | StribeckFriction
            | PreslidingFriction
            | QuadraticDrag
            | LoadDependentFriction => "friction",
            LinearStiffness | QuadraticStiffness | CubicStiffness | DeadZone | EndStop => "stiffness",
            BoucWenHysteresis => "hysteresis",
            InputSaturation | InputDeadZone | InputDelay | ActuatorLag | InputOffset => "actuation",
            Gravity | Cogging | PositionDependentInertia => "position_dependent",
            Coupling | UnmodeledResonance | FeedbackDelay => "structure",
            ConstantOffset | PeriodicDisturbance | StepDisturbance => "disturbance",
            ParameterDrift => "time_variation",
            SensorOffset | SensorDelay => "sensing",
            _ => "outside",
        }
    }

    /// Names of its parameters, in the order in which an effect holds their values.
    pub fn parameters(self) -> &'static [&'static str] {
        match self {
            ViscousFriction => &["b"],
            CoulombFriction => &["fc"],
            AsymmetricCoulombFriction => &["fcp", "fcn"],
            StribeckFriction => &["fc", "fs", "vs"],
            PreslidingFriction => &["s0", "fc"],
            QuadraticDrag => &["cd"],
            LoadDependentFriction => &["mul"],
            LinearStiffness => &["kg"],
            QuadraticStiffness => &["kq2"],
            CubicStiffness => &["k3"],
            DeadZone => &["gap"],
            EndStop => &["kst", "xst"],
            BoucWenHysteresis => &["kh", "be", "ga"],
            InputSaturation => &["usat"],
            InputDeadZone => &["udz"],
            InputDelay => &["tau"],
            ActuatorLag => &["ta"],
            InputOffset => &["uo"],
            Gravity => &["mgl"],
            Cogging => &["acg", "ncg", "pcg"],
            PositionDependentInertia => &["je", "n"],
            Coupling => &["kc", "cg", "mc"],
            UnmodeledResonance => &["ma", "ka", "ca"],
            FeedbackDelay => &["tau_f"],
            ConstantOffset => &["f0"],
            PeriodicDisturbance => &["ad", "fd", "pd"],
            StepDisturbance => &["fst", "t0"],
            ParameterDrift => &["rate"],
            SensorOffset => &["so"],
            SensorDelay => &["tsd"],
            DisplacementDamping => &["cx"],
            SineOfPower => &["asx", "nsx"],
            BreathingQuadratic => &["kqt", "fq"],
            PositionFriction => &["fqq"],
            ProductCoupling => &["kxx"],
            TiringActuator => &["bf", "tf"],
            QuinticStiffness => &["k5"],
            ParametricExcitation => &["ap", "fp"],
            EddyBrake => &["bv", "vb"],
            MaxwellElement => &["km", "tm"],
            AgeingFriction => &["fw", "vw", "tw"],
            OneWayDamper => &["bo"],
            PowerDrag => &["cp"],
            LockingSpring => &["ke", "le"],
        }
    }

    /// Whether it acts on what the input does.
    pub fn on_input(self) -> bool {
        matches!(
            self,
            InputSaturation | InputDeadZone | InputDelay | ActuatorLag | InputOffset | TiringActuator
        )
    }

    /// Whether it acts on a measurement.
    pub fn on_measurement(self) -> bool {
        matches!(self, SensorOffset | SensorDelay)
    }

    /// Whether it lies outside the library.
    pub fn is_outside(self) -> bool {
        OUTSIDE.contains(&self)
    }

    /// Whether it acts only beyond a threshold, and so has a true location in time.
    pub fn has_threshold(self) -> bool {
        matches!(
            self,
            EndStop | DeadZone | InputSaturation | InputDeadZone | StribeckFriction | StepDisturbance
        )
    }

    /// For an effect outside the library: the kinds of it that a fair judge accepts as near.
    pub fn relatives(self) -> &'static [&'static str] {
        match self {
            PositionFriction => &["load_dependent_friction"],
            ProductCoupling => &["coupling"],
            QuinticStiffness => &["cubic_stiffness", "end_stop"],
            TiringActuator => &["input_saturation"],
            AgeingFriction => &["coulomb_friction", "stribeck_friction"],
            PowerDrag => &["quadratic_drag"],
            LockingSpring => &["cubic_stiffness", "end_stop"],
            _ => &[],
        }
    }

    /// For an effect outside the library: the kind among its terms without a name that, beside a damper of the machine's own,
    /// is exactly this law. `None` where no term is.
    pub fn term(self) -> Option<&'static str> {
        Some(match self {
            DisplacementDamping => "position_dependent_damping",
            PositionFriction => "position_dependent_friction",
            ProductCoupling => "product_coupling",
            TiringActuator => "fading_input",
            QuinticStiffness => "quintic_stiffness",
            EddyBrake => "eddy_current_damping",
            MaxwellElement => "maxwell_element",
            OneWayDamper => "asymmetric_damping",
            _ => return None,
        })
    }
}
