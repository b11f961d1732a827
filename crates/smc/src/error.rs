//! What can be wrong with a design, and with a step of the law.

use core::fmt;

use crate::pole::Pole;

/// Why a law could not be designed, or an equilibrium not be found. The text says what to change.
#[derive(Debug, Clone, Copy, PartialEq)]
#[non_exhaustive]
pub enum SmcError {
    /// A number is NaN or infinite.
    NotFinite {
        /// What holds it.
        what: &'static str,
    },
    /// The input moves a state neither directly nor through other states.
    Unreached {
        /// Which, counted from 0.
        state: usize,
    },
    /// The tangent is not controllable, or hardly: it has no flat output.
    NotControllable {
        /// Of the controllability matrix, scaled; below 1e-12.
        reciprocal_condition: f64,
    },
    /// Powers of A, or the surface times them, are beyond floating point.
    Overflow,
    /// The input gain β is zero, or so large or small that a row overflows.
    InputGain {
        /// As given.
        beta: f64,
    },
    /// The pole λ of the surface is not positive, or its powers overflow.
    SurfacePole {
        /// As given, in 1/s.
        lambda: f64,
    },
    /// The last coefficient of the surface is not positive, or too small to divide by.
    SurfaceLeading {
        /// As given.
        value: f64,
    },
    /// Errors on the surface do not decay: its polynomial is not Hurwitz.
    SurfaceNotHurwitz {
        /// The first row of Routh's array, counted from 1, with a first element that is not positive.
        row: usize,
        /// That element.
        value: f64,
    },
    /// η is not a positive number.
    ReachingRate {
        /// As given, in units of s per s.
        eta: f64,
    },
    /// φ is not a positive number, or η/φ is none.
    LayerWidth {
        /// As given, in units of s.
        phi: f64,
    },
    /// The limit of the input is not positive.
    InputLimit {
        /// As given, in units of the input.
        limit: f64,
    },
    /// The sample time is not a positive number.
    SampleTime {
        /// As given, in s.
        dt: f64,
    },
    /// In the model, or in the plant, the input hardly acts on the surface.
    NoAuthority {
        /// Its strength relative to that in the tangent of the design.
        share: f64,
    },
    /// The held command crosses the boundary layer within a sample: (η/φ) dt ≥ 2.
    LayerTooThin {
        /// η/φ in 1/s.
        rate: f64,
        /// Sample time, s.
        dt: f64,
    },
    /// Inside the boundary layer the closed loop has a pole that is not in the left half plane.
    Unstable {
        /// The rightmost one, 1/s.
        pole: Pole,
    },
    /// The loop would be stable in continuous time, but not with a command held over the sample time.
    UnstableSampled {
        /// Sample time, s.
        dt: f64,
        /// Largest magnitude of a pole in z; 1 or more.
        spectral_radius: f64,
        /// The longest sample time found that is stable, s.
        longest: f64,
    },
    /// The iteration for the poles did not end.
    NoPoles,
    /// There is no such state to pin.
    PinnedState {
        /// As given, counted from 0.
        state: usize,
        /// How many states there are.
        states: usize,
    },
    /// The typical size of a state or of the input is not a positive number.
    TypicalSize {
        /// As given.
        size: f64,
    },
    /// At the pinned value the equations have no unique solution to first order.
    SingularEquilibrium {
        /// The pinned value at which Newton's method stands.
        value: f64,
    },
    /// Newton's method found no equilibrium.
    NoEquilibrium {
        /// The pinned value.
        value: f64,
        /// How many steps it took.
        iterations: usize,
        /// The last step, relative to the typical sizes.
        step: f64,
    },
}

impl fmt::Display for SmcError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match *self {
            Self::NotFinite { what } => write!(f, "{what}: not all numbers are finite; look where they come from"),
            Self::Unreached { state } => write!(
                f,
                "the input does not move state {state} (counted from 0), neither directly nor through other \
                 states; leave the state out, or look for the coupling that A or b lacks"
            ),
            Self::NotControllable { reciprocal_condition } => write!(
                f,
                "the tangent is not controllable to working precision (reciprocal condition of its \
                 controllability matrix {reciprocal_condition:.1e}, needed 1e-12), so that it has no flat output; \
                 leave out states that move together or hardly at all, or linearise elsewhere"
            ),
            Self::Overflow => f.write_str(
                "powers of A, or the surface times them, are beyond floating point; choose units of time, states \
                 and input in which A and b are nearer to 1",
            ),
            Self::InputGain { beta } => write!(
                f,
                "the input gain of the flat output is {beta}; it must be finite and not zero, nor so large that \
                 the rows overflow: 1 gives the surface the unit of the input"
            ),
            Self::SurfacePole { lambda } => write!(
                f,
                "the pole of the surface is at -lambda with lambda = {lambda} 1/s; lambda must be positive, and its \
                 powers within floating point"
            ),
            Self::SurfaceLeading { value } => write!(
                f,
                "the last coefficient of the surface, that of the highest derivative, is {value}; it must be \
                 positive: write the coefficients by rising power, the last one 1"
            ),
            Self::SurfaceNotHurwitz { row, value } => write!(
                f,
                "errors on the surface would not decay: row {row} of Routh's array starts with {value}, where all \
                 must be positive; take the coefficients from poles in the left half plane, as Surface::repeated \
                 does"
            ),
            Self::ReachingRate { eta } => {
                write!(f, "the reaching rate eta is {eta}; it must be positive and finite")
            }
            Self::LayerWidth { phi } => write!(
                f,
                "the width phi of the boundary layer is {phi}; phi and eta/phi must be positive and finite"
            ),
            Self::InputLimit { limit } => write!(
                f,
                "the limit of the input is {limit}; it must be positive: the largest magnitude that the actuator \
                 gives, or infinity for none"
            ),
            Self::SampleTime { dt } => write!(f, "the sample time is {dt} s; it must be positive and finite"),
            Self::NoAuthority { share } => write!(
                f,
                "the input acts on the surface with {share:.1e} of the strength that it has in the tangent of the \
                 design, needed 1e-3; take the tangent of the design near the one of the model"
            ),
            Self::LayerTooThin { rate, dt } => write!(
                f,
                "a command held over {dt} s crosses the boundary layer: (eta/phi) dt = {:.3}, which must be below \
                 2; widen the layer to phi > {:.3e} eta, or sample faster than every {:.3e} s",
                rate * dt,
                0.5 * dt,
                2.0 / rate
            ),
            Self::Unstable { pole } => write!(
                f,
                "inside the boundary layer the closed loop has a pole at {pole} 1/s; raise lambda, or take the \
                 flat output from the tangent of the plant itself (Design::new), which leaves the poles of the \
                 surface and -eta/phi; if that is so already, the model passed to the law is not the plant's"
            ),
            Self::UnstableSampled { dt, spectral_radius, longest } => {
                write!(
                    f,
                    "with the command held over {dt} s the closed loop is unstable: its largest pole in z has the \
                     magnitude {spectral_radius:.6}; "
                )?;
                if longest > 0.0 {
                    write!(f, "sample every {longest:.3e} s or faster, or lower lambda or eta/phi")
                } else {
                    f.write_str("lower lambda or eta/phi")
                }
            }
            Self::NoPoles => f.write_str(
                "the iteration for the poles did not end; choose units in which A, b and the gains are nearer to 1",
            ),
            Self::PinnedState { state, states } => {
                write!(f, "there is no state {state} to pin: the {states} states are counted from 0")
            }
            Self::TypicalSize { size } => {
                write!(f, "a typical size is {size}; it must be positive and finite")
            }
            Self::SingularEquilibrium { value } => write!(
                f,
                "with the pinned state at {value} the equations of the equilibrium are singular; pin a state that \
                 the input can hold anywhere, or ask for a value farther from where equilibria meet"
            ),
            Self::NoEquilibrium { value, iterations, step } => write!(
                f,
                "no equilibrium with the pinned state at {value} after {iterations} steps of Newton's method (the \
                 last of relative size {step:.1e}); start from the equilibrium of a nearer value, or ask for one \
                 within the reach of the plant"
            ),
        }
    }
}

impl core::error::Error for SmcError {}

/// Why a step of the law gives no command.
#[derive(Debug, Clone, Copy, PartialEq)]
#[non_exhaustive]
pub enum Fault {
    /// The state, f, g or the target is not finite, or the law overflows.
    NotFinite,
    /// At this state the input hardly acts on the surface.
    Authority {
        /// Its strength relative to that in the tangent of the design.
        share: f64,
    },
}

impl fmt::Display for Fault {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match *self {
            Self::NotFinite => f.write_str(
                "the state, the model's f and g or the target are not finite; hold the last command or switch off, \
                 and look at the sensor",
            ),
            Self::Authority { share } => write!(
                f,
                "the input acts on the surface with {share:.1e} of its strength in the design; hold the last \
                 command or switch off, and keep the target nearer to the point of the design"
            ),
        }
    }
}

impl core::error::Error for Fault {}
