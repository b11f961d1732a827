//! Why an identification could not be done.

use greybox_calibrate::DataError;
use greybox_model::ModelError;

/// What is wrong with a request or its recordings.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum IdentifyError {
    /// No state was named.
    #[error("no state is named: say which channels are the coordinates of the machine")]
    NoStates,
    /// A name stands twice.
    #[error("channel `{name}` is named twice, as {first} and as {second}: each channel has one role")]
    Twice {
        /// The channel.
        name: String,
        /// Its first role.
        first: &'static str,
        /// Its second role.
        second: &'static str,
    },
    /// A channel's name cannot be used in an equation.
    #[error(
        "channel `{name}` cannot be a name in an equation: {reason}; rename it in the recording's header"
    )]
    Name {
        /// The channel.
        name: String,
        /// What the model language says.
        reason: String,
    },
    /// A term of the user that the model language does not understand.
    #[error("term `{term}`: {reason}")]
    Term {
        /// As given.
        term: String,
        /// What is wrong.
        reason: String,
    },
    /// A term without a state or input in it.
    #[error("term `{term}` has neither a state nor an input in it; --library constant adds a constant force")]
    ConstantTerm {
        /// As given.
        term: String,
    },
    /// Sines of states that are no angles.
    #[error(
        "the library has sines, but none of the states ({states}) is an angle; leave `trigonometric` and `lagrangian` out, \
         or give the angle's channel the unit `rad` or `deg`"
    )]
    NoAngle {
        /// The states.
        states: String,
    },
    /// Not one leading derivative for every state.
    #[error(
        "{given} orders of leading derivatives are given for the states {states}: give one for every state"
    )]
    Derivatives {
        /// Number given.
        given: usize,
        /// The states.
        states: String,
    },
    /// A setting outside its range.
    #[error("{what} is {found}, but must lie in {range}")]
    Range {
        /// The setting.
        what: &'static str,
        /// Its value.
        found: f64,
        /// Admissible values.
        range: &'static str,
    },
    /// More inputs than equations can be told apart by.
    #[error("an input must be named for a delayed state: without one the gain of the feedback sets no scale")]
    DelayWithoutInput,
    /// A delayed feedback and equations that share coefficients.
    #[error(
        "a delayed feedback stands beside one input in every equation, which terms of energies shared by several equations do \
         not allow; leave `lagrangian` or the delay out"
    )]
    DelayWithEnergies,
    /// The delayed state is none of the states.
    #[error("the delayed state `{name}` is not among the states {states}")]
    DelayedState {
        /// As given.
        name: String,
        /// The states.
        states: String,
    },
    /// An input with a dead time that is none of the inputs.
    #[error("the input `{name}` with a dead time is not among the inputs ({inputs})")]
    LateInput {
        /// As given.
        name: String,
        /// The inputs.
        inputs: String,
    },
    /// One input with two dead times.
    #[error("the input `{name}` is given two dead times: name it once")]
    TwoDeadTimes {
        /// The input.
        name: String,
    },
    /// A delayed feedback and a dead time.
    #[error(
        "a delayed feedback and the dead time of an input are not looked for together; leave one of them out, or write both \
         into a model and calibrate it"
    )]
    DelayAndDeadTime,
    /// Delays are looked for that no recording can show.
    #[error(
        "delays up to {longest} s are looked for, but the longest stretch without a gap lasts {recorded:.4} s: look for \
         delays much shorter than that"
    )]
    LongestDelay {
        /// Longest delay asked for, s.
        longest: f64,
        /// Longest stretch, s.
        recorded: f64,
    },
    /// The library is larger than the data can carry.
    #[error("{candidates} candidate terms on {samples} samples: too many; lower the order or record longer")]
    TooManyTerms {
        /// Number of candidates.
        candidates: usize,
        /// Number of samples.
        samples: usize,
    },
    /// A coordinate that does not move.
    #[error("channel `{name}` does not move: nothing can be learnt about it; excite the machine")]
    Still {
        /// The channel.
        name: String,
    },
    /// The recordings are too short for one window of the weak form.
    #[error(
        "the longest gap-free stretch has {samples} samples: too few for a first estimate of the equation"
    )]
    TooShort {
        /// Its length.
        samples: usize,
    },
    /// No model could be fitted.
    #[error(
        "no equation of this library follows the recordings: every fit diverged; try another library or a lower order"
    )]
    NoFit,
    /// A delayed feedback and recordings read in blocks.
    #[error(
        "a delayed feedback is not looked for in blocks, whose starts do not know the past; read whole recordings"
    )]
    DelayInBlocks,
    /// A dead time and recordings read in blocks.
    #[error(
        "the dead time of an input is not looked for in blocks, whose starts do not know the past; read whole recordings"
    )]
    DeadTimeInBlocks,
    /// No block was given.
    #[error("there is no block to identify anything from")]
    NoBlocks,
    /// Statistics made around different models.
    #[error("statistics of blocks were made around different models: map all blocks around the same one")]
    Mixed,
    /// The recordings do not fit the model that the request describes.
    #[error(transparent)]
    Data(#[from] DataError),
    /// The model language refuses what the request describes.
    #[error(transparent)]
    Model(#[from] ModelError),
}
