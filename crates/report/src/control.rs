//! What the page of a controller shows: the law, what its simulated loop reached, and what it was checked for.
//!
//! Plain data, filled by the caller ([`crate::convert::control`]). All numbers are SI; units are those of
//! [`Quantity::unit`]. A number that is not finite is shown as unknown.

use greybox_control::{Margins, Metrics, Tracking, Verdict};

use crate::contract::{ModelId, Producer};

/// Everything the page of a controller shows; [`ControlPage::to_html`] writes it.
#[derive(Debug, Clone, PartialEq)]
pub struct ControlPage {
    /// Heading of the page and title of the window.
    pub title: String,
    /// What made the page.
    pub producer: Producer,
    /// The model the law was designed on.
    pub model: ModelId,
    /// What the simulated loops did.
    pub verdict: Verdict,
    /// How the law was found.
    pub method: LawKind,
    /// Further settings of the design: name and value.
    pub settings: Vec<(&'static str, String)>,
    /// The command.
    pub input: Quantity,
    /// Its range; infinite where there is no limit.
    pub limits: [f64; 2],
    /// Sample time of the law, s.
    pub dt: f64,
    /// The states that the law reads.
    pub states: Vec<LawState>,
    /// Which of them is brought to the set points.
    pub tracked: usize,
    /// The name of the set point in the law.
    pub reference: String,
    /// The law in the model language.
    pub law: String,
    /// The observer between the sensors and the law; none where the law is given the full state.
    pub observer: Option<ObserverPage>,
    /// How old what the law is given is in the simulated loop, s.
    pub delay: f64,
    /// Terms of the model that the design left out: equation and term.
    pub left_out: Vec<(String, String)>,
    /// The tangent of the loop at each set point.
    pub set_points: Vec<SetPoint>,
    /// What the simulated loop reached, set point by set point.
    pub steps: Vec<Metrics>,
    /// Whether the reference is a trajectory instead of set points.
    pub is_trajectory: bool,
    /// Whether the law reads its first two derivatives too.
    pub reads_derivatives: bool,
    /// How the trajectory was followed; none for set points, and where the loop left every bound.
    pub tracking: Option<Tracking>,
    /// The same law on perturbed plants.
    pub family: Option<Perturbed>,
    /// The simulated loop.
    pub run: LoopRun,
    /// The files beside the page and what they hold.
    pub files: Vec<(&'static str, &'static str)>,
}

/// An observer.
#[derive(Debug, Clone, PartialEq)]
pub struct ObserverPage {
    /// Which one.
    pub kind: &'static str,
    /// The name of the estimated disturbance in the law.
    pub disturbance: String,
    /// The integral action of the law.
    pub integral: IntegralAction,
    /// What is measured.
    pub sensors: Vec<SensorPage>,
}

/// The integral action of a law behind an observer.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum IntegralAction {
    /// None.
    Off,
    /// The law takes the estimated disturbance off the command.
    Disturbance,
    /// The error of a machine at rest.
    AtRest {
        /// How long the tracked state's reading stays before the machine is at rest, s.
        time: f64,
        /// Error that is left, SI.
        step: f64,
        /// Integral time, s.
        integral_time: f64,
    },
}

/// A sensor.
#[derive(Debug, Clone, PartialEq)]
pub struct SensorPage {
    /// The measured state.
    pub quantity: Quantity,
    /// Standard deviation of its noise.
    pub noise: f64,
    /// Step of its values; zero for none.
    pub resolution: f64,
}

/// How a law was found.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum LawKind {
    /// Linear-quadratic regulator.
    Lqr,
    /// Value function of the Hamilton–Jacobi–Bellman equation.
    Hjb,
    /// Flat-output sliding mode.
    Smc,
}

/// A name of the model with its SI unit.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Quantity {
    /// As the model writes it, with its primes.
    pub name: String,
    /// SI unit; empty where none is known.
    pub unit: String,
}

/// A state that the law reads.
#[derive(Debug, Clone, PartialEq)]
pub struct LawState {
    /// The state.
    pub quantity: Quantity,
    /// Its typical size in the design.
    pub size: f64,
    /// Gain K of u = u_e − K (x − x_e) near the design point.
    pub gain: f64,
}

/// The loop's tangent at a set point.
#[derive(Debug, Clone, PartialEq)]
pub struct SetPoint {
    /// The set point.
    pub value: f64,
    /// The equilibrium there, in the order of [`ControlPage::states`].
    pub state: Vec<f64>,
    /// The command that holds it.
    pub command: f64,
    /// Poles of the continuous loop (real, imaginary part), 1/s.
    pub poles: Vec<[f64; 2]>,
    /// Poles in z with the command held over the sample time.
    pub held_poles: Vec<[f64; 2]>,
    /// Poles of the continuous loop while friction holds the tracked state, 1/s; empty where it does not.
    pub stuck_poles: Vec<[f64; 2]>,
    /// Margins of the loop as it is fed back, cut at the command.
    pub margins: Option<Margins>,
}

/// One law on perturbed plants.
#[derive(Debug, Clone, PartialEq)]
pub struct Perturbed {
    /// Plants.
    pub members: usize,
    /// Those whose state or command left every bound.
    pub diverged: usize,
    /// Those that settled at every set point, or stayed with the trajectory.
    pub settled: usize,
    /// The perturbed parameters: quantity, value, standard deviation.
    pub deviations: Vec<(Quantity, f64, f64)>,
    /// A figure's name, its unit, and the median and the worst of the members; infinite where not reached.
    pub figures: Vec<Figure>,
    /// Margins on the perturbed plants; none where the law has none on its own.
    pub margins: Option<PerturbedMargins>,
    /// Least and largest tracked state of the members that did not diverge, at the times of the run.
    pub tracked: [Vec<f64>; 2],
    /// The same of the command.
    pub command: [Vec<f64>; 2],
}

/// Margins over the perturbed plants, of each plant those of its worst set point, margin by margin.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PerturbedMargins {
    /// On the model itself.
    pub own: Margins,
    /// Half of the plants have more.
    pub median: Margins,
    /// The worst plant.
    pub worst: Margins,
    /// Plants on which the linearised loop is unstable at a set point.
    pub unstable: usize,
}

/// A figure over the perturbed plants.
#[derive(Debug, Clone, PartialEq)]
pub struct Figure {
    /// Its name.
    pub name: &'static str,
    /// Unit; `%` for a ratio.
    pub unit: String,
    /// On the model itself, the worst set point.
    pub own: f64,
    /// Half of the plants are better.
    pub median: f64,
    /// The worst plant.
    pub worst: f64,
}

/// The simulated loop.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct LoopRun {
    /// Time, s.
    pub t: Vec<f64>,
    /// Set point.
    pub reference: Vec<f64>,
    /// Command, held until the next sample.
    pub command: Vec<f64>,
    /// Every state of the simulated model.
    pub states: Vec<(Quantity, Vec<f64>)>,
    /// Which of them is tracked.
    pub tracked: usize,
    /// When the loop left every bound, s.
    pub diverged: Option<f64>,
}
