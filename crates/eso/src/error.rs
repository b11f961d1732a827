//! What can be wrong with a design, a step or a slice.

use core::fmt;

/// Why an observer could not be made, or a record not be run through it.
#[derive(Debug, Clone, Copy, PartialEq)]
#[non_exhaustive]
pub enum EsoError {
    /// The exponent α of `fal` is outside [0, 1].
    Exponent {
        /// As given.
        alpha: f64,
    },
    /// The width δ of the linear zone of `fal` is not a positive number.
    Width {
        /// As given, in units of the error.
        delta: f64,
    },
    /// A gain β is not a positive number.
    Gain {
        /// Which, counted from 1 as in βᵢ.
        index: usize,
        /// As given, in 1/sⁱ times the unit that its `fal` leaves.
        value: f64,
    },
    /// The bandwidth ω is not a positive number, or its powers overflow.
    Bandwidth {
        /// As given, in rad/s.
        omega: f64,
    },
    /// Near e = 0 the error would grow: sᴺ + l₁ sᴺ⁻¹ + … + l_N is not Hurwitz.
    NotHurwitz,
    /// The sample time is not a positive number.
    Step {
        /// As given, in s.
        step: f64,
    },
    /// Explicit Euler with this step is unstable around e = 0.
    StepTooLong {
        /// As given, in s.
        step: f64,
        /// The first step that is too long, in s.
        limit: f64,
    },
    /// The printed linear branch of `fal` jumps at |e| = δ, so that an implicit step has no unique solution.
    PrintedBranch,
    /// The gain b of the known input is not finite.
    InputGain {
        /// As given.
        gain: f64,
    },
    /// An extended state needs a state of the plant before it: N ≥ 2.
    NothingToExtend,
    /// A state was asked for that the observer does not have.
    State {
        /// As given, counted from 0.
        state: usize,
        /// How many states there are.
        order: usize,
    },
    /// Two slices that go together differ in length.
    Length {
        /// What is too long or too short.
        what: &'static str,
        /// Its length.
        found: usize,
        /// The length that it should have.
        expected: usize,
    },
    /// A shift that is negative or not finite.
    Shift {
        /// As given, in samples.
        shift: f64,
    },
}

impl fmt::Display for EsoError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match *self {
            Self::Exponent { alpha } => {
                write!(f, "fal: the exponent alpha is {alpha}; it must lie in [0, 1]")
            }
            Self::Width { delta } => {
                write!(
                    f,
                    "fal: the width delta of the linear zone is {delta}; it must be positive and finite"
                )
            }
            Self::Gain { index, value } => {
                write!(f, "gain beta_{index} is {value}; it must be positive and finite")
            }
            Self::Bandwidth { omega } => write!(
                f,
                "the bandwidth is {omega} rad/s; it must be positive, and its powers finite: choose a smaller one"
            ),
            Self::NotHurwitz => f.write_str(
                "the gains make the observer unstable around zero error; \
                 take them from a bandwidth (Design::from_bandwidth) or lower the last ones",
            ),
            Self::Step { step } => write!(f, "the sample time is {step} s; it must be positive and finite"),
            Self::StepTooLong { step, limit } => write!(
                f,
                "explicit Euler with a step of {step} s is unstable, the limit for these gains is {limit} s; \
                 sample faster, lower the gains or use Scheme::Trapezoidal"
            ),
            Self::PrintedBranch => f.write_str(
                "the linear branch of fal as printed jumps at |e| = delta, an implicit step has no unique \
                 solution; use Scheme::Euler or Han's branch",
            ),
            Self::InputGain { gain } => write!(f, "the gain of the input is {gain}; it must be finite"),
            Self::NothingToExtend => {
                f.write_str("an observer of one state cannot be extended; use two states or more")
            }
            Self::State { state, order } => {
                write!(f, "there is no state {state}: the {order} states are counted from 0")
            }
            Self::Length { what, found, expected } => {
                write!(f, "{what} has {found} samples where {expected} are needed")
            }
            Self::Shift { shift } => {
                write!(f, "a shift of {shift} samples; it must be zero or positive, and finite")
            }
        }
    }
}

impl core::error::Error for EsoError {}
