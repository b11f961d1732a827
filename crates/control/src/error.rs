//! What can be wrong on the way from a model to a controller.

use greybox_eso::EsoError;
use greybox_hjb::{HjbError, RiccatiError};
use greybox_model::system::CompileError;
use greybox_model::tape::UnknownName;
use greybox_smc::SmcError;
use greybox_smc::check::Pole;

/// Why there is no plant, no equilibrium, no controller or no closed loop. The text says what to change.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum ControlError {
    /// The input is not one of the model's.
    #[error("the model has no input `{name}`: give one of {known}")]
    UnknownInput {
        /// As given.
        name: String,
        /// The model's inputs.
        known: String,
    },
    /// A state, with its primes, is not one of the plant's.
    #[error("the plant has no state `{name}`: give one of {known}")]
    UnknownState {
        /// As given.
        name: String,
        /// The plant's states.
        known: String,
    },
    /// A parameter is not one of the model's.
    #[error("the model has no parameter `{name}`: give one of {known}")]
    UnknownParameter {
        /// As given.
        name: String,
        /// The model's parameters.
        known: String,
    },
    /// An equation uses a name that the model does not have, or a function with the wrong number of arguments.
    #[error(
        "equation \"{equation}\": `{expression}` has no meaning here: load the model from its text to see why"
    )]
    Meaningless {
        /// Name of the equation.
        equation: String,
        /// The name or the call.
        expression: String,
    },
    /// The control input is also held at a constant.
    #[error(
        "the input `{name}` cannot be the command and be held at a constant at once: take it from one of the two"
    )]
    TwoRoles {
        /// The input.
        name: String,
    },
    /// There are not as many equations as states.
    #[error("{equations} equations for {states} states: give one equation for each state")]
    Count {
        /// Number of equations.
        equations: usize,
        /// Number of states.
        states: usize,
    },
    /// A delay.
    #[error(
        "equation \"{equation}\": the plant remembers its past in `{expression}`, and a feedback of the state is no \
         law for that: leave the delay out of the model for the design, and simulate the law on the model with it; an \
         observer predicts over a delay of the command (output feedback, `predict_input_delay`)"
    )]
    Delay {
        /// Name of the equation.
        equation: String,
        /// The delayed expression.
        expression: String,
    },
    /// The command acts at several times.
    #[error(
        "the input `{input}` acts at several times: one delay of it can be predicted over, the same wherever it acts"
    )]
    SeveralDelays {
        /// The input.
        input: String,
    },
    /// A delay of too many samples.
    #[error("the command acts {samples} samples late, and {most} can be predicted over: sample more slowly")]
    LongDelay {
        /// Samples, rounded up.
        samples: usize,
        /// How many would do.
        most: usize,
    },
    /// An explicit time.
    #[error(
        "equation \"{equation}\": the term `{term}` depends on the time, and a design needs a time-invariant model: \
         remove this disturbance, or ask for time terms to be ignored (`ignore_time_terms`)"
    )]
    Time {
        /// Name of the equation.
        equation: String,
        /// The term.
        term: String,
    },
    /// A coefficient that depends on the time.
    #[error(
        "equation \"{equation}\": in `{term}` the time multiplies a state or an input, so that the term cannot be \
         dropped: write the value that the coefficient has while the controller runs"
    )]
    Drift {
        /// Name of the equation.
        equation: String,
        /// The term.
        term: String,
    },
    /// A highest derivative or the input does not enter linearly.
    #[error(
        "equation \"{equation}\" is not affine in {of}: a law needs ẋ = f(x) + g(x) u; leave the nonlinearity of \
         the actuator out and compensate it, or make what it makes of `{symbol}` the input"
    )]
    NotAffine {
        /// Name of the equation.
        equation: String,
        /// The highest derivatives, or the input.
        of: &'static str,
        /// Their names.
        symbol: String,
    },
    /// The equations cannot be solved for the highest derivatives.
    #[error(
        "the equations cannot be solved for {unknowns}: their mass matrix is singular{place}; give every coordinate \
         an inertia of its own, or leave it out"
    )]
    Singular {
        /// The highest derivatives.
        unknowns: String,
        /// Where, if not everywhere.
        place: &'static str,
    },
    /// More coupled coordinates than are solved for in symbols.
    #[error(
        "{count} coordinates ({unknowns}) are coupled through their inertias, and {most} can be solved for in \
         symbols: write some equations with the accelerations of the others eliminated"
    )]
    TooManyCoupled {
        /// How many.
        count: usize,
        /// Their highest derivatives.
        unknowns: String,
        /// How many would do.
        most: usize,
    },
    /// The input moves nothing.
    #[error("the input `{name}` moves no state of the plant: choose the input that the actuator has")]
    NoAuthority {
        /// The input.
        name: String,
    },
    /// A number that makes no sense.
    #[error("{what} is {value}: it must be {wanted}")]
    Option {
        /// What it is.
        what: String,
        /// As given.
        value: f64,
        /// The fix.
        wanted: &'static str,
    },
    /// The limits of the actuator leave no room.
    #[error(
        "the limits of the input, {low} and {high}, leave no room around zero: check the saturation's parameters"
    )]
    Limits {
        /// Lower one.
        low: f64,
        /// Upper one.
        high: f64,
    },
    /// A list of another length.
    #[error("{what} has {found} entries, and the plant needs {wanted}")]
    Size {
        /// What it is.
        what: &'static str,
        /// As given.
        found: usize,
        /// As needed.
        wanted: usize,
    },
    /// The equations are not finite where they must be.
    #[error(
        "the plant's equations are not finite at x = {state:?}: stay away from it, or correct the model there"
    )]
    NotFinite {
        /// The state.
        state: Vec<f64>,
    },
    /// At the wanted value the equations have no unique solution to first order.
    #[error(
        "at {tracked} = {value} the rest position is not determined{by}: freeze a state that nothing brings to rest \
         (a memory of friction or hysteresis, `frozen`), close a \
         gap (`close_gaps`), or track the coordinate that the input can hold"
    )]
    SingularEquilibrium {
        /// The tracked state.
        tracked: String,
        /// Its wanted value.
        value: f64,
        /// The state or equation that is left over.
        by: String,
    },
    /// Newton's method found no rest position.
    #[error(
        "no state of rest with {tracked} = {value} was found (the last step was {step:.1e} of the stated sizes): \
         narrow the range of set points, or state sizes nearer to those of the motion"
    )]
    NoEquilibrium {
        /// The tracked state.
        tracked: String,
        /// Its wanted value.
        value: f64,
        /// The last step.
        step: f64,
    },
    /// No state of rest belongs to what is measured.
    #[error(
        "no state of rest was found that belongs to the measurements {measured:?} under the command {command}: start the \
         observer from zero, bring the machine nearer to the set points, or state sizes nearer to those of the motion"
    )]
    NoStart {
        /// What is measured.
        measured: Vec<f64>,
        /// The command that is held.
        command: f64,
    },
    /// Resting there needs more than the actuator gives.
    #[error(
        "resting at {tracked} = {value} takes an input of {input}, and the actuator gives {low} to {high}: narrow \
         the set points"
    )]
    Unholdable {
        /// The tracked state.
        tracked: String,
        /// The set point.
        value: f64,
        /// The input it takes.
        input: f64,
        /// Lower limit.
        low: f64,
        /// Upper limit.
        high: f64,
    },
    /// No linear regulator.
    #[error("linear design at the set point {set_point}: {source}{hint}")]
    Linear {
        /// Where.
        set_point: f64,
        /// Why.
        source: RiccatiError,
        /// What may be the matter, where something is known.
        hint: &'static str,
    },
    /// No nonlinear optimal law.
    #[error("Hamilton-Jacobi-Bellman design at the set point {set_point}: {source}{hint}")]
    Hjb {
        /// Where.
        set_point: f64,
        /// Why.
        source: HjbError,
        /// What may be the matter, where something is known.
        hint: &'static str,
    },
    /// No sliding-mode law.
    #[error("sliding-mode design at the set point {set_point}: {source}{hint}")]
    Smc {
        /// Where.
        set_point: f64,
        /// Why.
        source: SmcError,
        /// What may be the matter, where something is known.
        hint: &'static str,
    },
    /// More states than a sliding-mode law is made for.
    #[error(
        "a sliding-mode law is made for 1 to 8 states, and the plant has {states}: freeze some, or use LQR"
    )]
    SmcStates {
        /// Number of states.
        states: usize,
    },
    /// A pole of the closed loop's tangent that is not in the left half plane.
    #[error(
        "the closed loop is unstable at the set point {set_point}: a pole at {pole} 1/s; design nearer to this set \
         point, or narrow the range"
    )]
    Unstable {
        /// Where.
        set_point: f64,
        /// The rightmost pole, 1/s.
        pole: Pole,
    },
    /// A pole of the sampled loop outside the unit circle.
    #[error(
        "with the command held over {dt} s the closed loop is unstable at the set point {set_point} (a pole in z of \
         magnitude {radius:.4}): sample faster{longest}, or ask for a slower loop"
    )]
    UnstableSampled {
        /// Where.
        set_point: f64,
        /// Sample time, s.
        dt: f64,
        /// The largest magnitude.
        radius: f64,
        /// A sample time that would do, as text.
        longest: String,
    },
    /// The eigenvalues were not found.
    #[error(
        "the poles at the set point {set_point} were not found: state sizes nearer to those of the motion"
    )]
    NoPoles {
        /// Where.
        set_point: f64,
    },
    /// Plant and observer together are unstable when sampled.
    #[error(
        "with its observer the closed loop is unstable at the set point {set_point} (a pole in z of magnitude {radius:.4}, \
         sampled every {dt} s): sample faster, or give the observer another bandwidth or disturbance"
    )]
    UnstableOutput {
        /// Where.
        set_point: f64,
        /// Sample time, s.
        dt: f64,
        /// The largest magnitude.
        radius: f64,
    },
    /// No Kalman filter.
    #[error(
        "the observer cannot be designed: {source}; the measured states must determine the others and a constant \
         disturbance of the command: measure the tracked state too"
    )]
    Observer {
        /// Why.
        source: RiccatiError,
    },
    /// No extended-state observer.
    #[error("the extended-state observer cannot be designed: {source}")]
    Eso {
        /// Why.
        source: EsoError,
    },
    /// A coordinate that an extended-state observer cannot follow.
    #[error(
        "an extended-state observer follows measured coordinates, and `{name}` is not measured: use the Kalman filter"
    )]
    EsoUnmeasured {
        /// The coordinate.
        name: String,
    },
    /// A coordinate of too high an order for an extended-state observer.
    #[error(
        "the coordinate `{name}` has {order} states, and an extended-state observer is made for 1 to 3: use the Kalman filter"
    )]
    EsoOrder {
        /// The coordinate.
        name: String,
        /// Its number of states.
        order: usize,
    },
    /// No state of the plant is measured.
    #[error("none of the states {known} is measured: an observer needs one that a channel measures as it is")]
    NothingMeasured {
        /// The plant's states.
        known: String,
    },
    /// A sensor of a state that is not measured.
    #[error("no sensor measures `{name}`: give one of {known}")]
    NotMeasured {
        /// As given.
        name: String,
        /// The measured states.
        known: String,
    },
    /// The model does not compile.
    #[error("the model cannot be simulated: {0}")]
    Compile(#[from] CompileError),
    /// A name is left over in an expression of the law.
    #[error("the law uses an {0}: this is a fault of the program")]
    Name(#[from] UnknownName),
    /// The closed loop is to be simulated on a model that lacks a state of the law.
    #[error(
        "the simulated model lacks `{name}`, which the law needs: simulate the model that the law was made for"
    )]
    Foreign {
        /// State or input.
        name: String,
    },
    /// A velocity that cannot be had from measurements.
    #[error(
        "the state `{name}` is neither measured nor the rate of a measured one: feed back the full state, or add \
         an observer"
    )]
    Unmeasured {
        /// The state.
        name: String,
    },
}

/// `a`, `b` and `c`, for messages.
pub(crate) fn listed<S: AsRef<str>>(names: impl IntoIterator<Item = S>) -> String {
    let names: Vec<String> = names.into_iter().map(|n| format!("`{}`", n.as_ref())).collect();
    if names.is_empty() { "none: the model has none".into() } else { names.join(", ") }
}
