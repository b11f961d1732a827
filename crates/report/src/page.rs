//! What the HTML page shows beyond `report.json`: the signals, the residual, the curves, the model texts.
//!
//! Plain data, filled by the caller. A series that is not known stays empty (`Vec::new()`); the page then
//! leaves that line or section out. All series of one time axis have its length; a longer one is cut and a
//! shorter one is drawn as far as it goes. NaN draws a gap.

use crate::contract::{Interval, Report};
use crate::identified::IdentifyReport;

/// Everything one page shows.
#[derive(Debug, Clone, PartialEq)]
pub struct Page {
    /// Heading of the page and title of the window, e.g. the model's name.
    pub title: String,
    /// The contract: verdict, mechanisms, parameters, fit, findings.
    pub report: Report,
    /// The recordings with what the three models say about them.
    pub recordings: Vec<Recording>,
    /// The residual on training data, by channel.
    pub residuals: Vec<Residual>,
    /// Mechanism curves against residual points, and the shape of what is unexplained.
    pub mechanism_plots: Vec<MechanismPlot>,
    /// The model before and after.
    pub models: ModelTexts,
}

/// Everything the page of an identification shows. Its recordings and residuals have the identified model in
/// the place of the improved one; the nominal and the calibrated series are empty.
#[derive(Debug, Clone, PartialEq)]
pub struct IdentifyPage {
    /// Heading of the page and title of the window.
    pub title: String,
    /// The contract: equations, order, delay, fit, findings.
    pub report: IdentifyReport,
    /// The recordings with what the model says about them.
    pub recordings: Vec<Recording>,
    /// The residual on training data, by channel.
    pub residuals: Vec<Residual>,
    /// The model that was written.
    pub model_text: String,
}

/// Whether a recording was used for fitting.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Role {
    /// Used to choose and fit.
    Train,
    /// Never used to choose or fit anything.
    Holdout,
}

/// One recording and the free-run simulations on its inputs.
#[derive(Debug, Clone, PartialEq)]
pub struct Recording {
    /// File name.
    pub name: String,
    /// Train or held out.
    pub role: Role,
    /// Time in s from the start of the recording, ascending.
    pub t: Vec<f64>,
    /// Start in s of a held-out last part, when the recording is split.
    pub holdout_from: Option<f64>,
    /// The measured channels.
    pub channels: Vec<Channel>,
    /// The inputs.
    pub inputs: Vec<Input>,
}

/// One measured channel.
#[derive(Debug, Clone, PartialEq)]
pub struct Channel {
    /// Name in the recording.
    pub name: String,
    /// Unit; empty when none was stated.
    pub unit: String,
    /// Measurement.
    pub measured: Vec<f64>,
    /// Free run of the model as given.
    pub nominal: Vec<f64>,
    /// Free run of the calibrated model.
    pub calibrated: Vec<f64>,
    /// Free run of the improved model.
    pub improved: Vec<f64>,
}

/// One input.
#[derive(Debug, Clone, PartialEq)]
pub struct Input {
    /// Name in the recording.
    pub name: String,
    /// Unit; empty when none was stated.
    pub unit: String,
    /// Values at the recording's times.
    pub values: Vec<f64>,
}

/// The residual of one channel on one training recording, and where it lives.
#[derive(Debug, Clone, PartialEq)]
pub struct Residual {
    /// File name of the recording.
    pub recording: String,
    /// Channel.
    pub channel: String,
    /// Unit of the channel.
    pub unit: String,
    /// Time in s.
    pub t: Vec<f64>,
    /// Measurement − calibrated model.
    pub before: Vec<f64>,
    /// Measurement − improved model.
    pub after: Vec<f64>,
    /// Standard deviation of the measurement noise, in the channel's unit; NaN where unknown.
    pub noise_sigma: f64,
    /// Time windows in s in which the mechanism acts.
    pub windows: Vec<Interval>,
    /// Amplitude spectra of the residual.
    pub spectrum: Option<Spectrum>,
    /// Magnitude of the residual over two coordinates of the state space.
    pub map: Option<StateMap>,
    /// Correlation of the residual with itself, at lags above zero, and with the inputs.
    pub correlations: Vec<Lagged>,
}

/// Correlation of a residual with itself or with an input, over the lag.
#[derive(Debug, Clone, PartialEq)]
pub struct Lagged {
    /// Name of the input; `None` for the residual itself.
    pub with: Option<String>,
    /// Lags in s, ascending.
    pub lag: Vec<f64>,
    /// Residual of the calibrated model, −1 … 1; empty where there is none.
    pub before: Vec<f64>,
    /// Residual of the improved model.
    pub after: Vec<f64>,
    /// Magnitude that one value of a hundred exceeds by chance, of the improved model's.
    pub bound: f64,
}

/// One-sided amplitude spectral densities.
#[derive(Debug, Clone, PartialEq)]
pub struct Spectrum {
    /// Frequency in Hz, ascending.
    pub freq: Vec<f64>,
    /// Residual of the calibrated model, unit/√Hz.
    pub before: Vec<f64>,
    /// Residual of the improved model, unit/√Hz.
    pub after: Vec<f64>,
    /// Estimated noise, unit/√Hz; empty where unknown.
    pub noise: Vec<f64>,
}

/// Where in the state space the calibrated model's residual is large: one point per sample or bin.
#[derive(Debug, Clone, PartialEq)]
pub struct StateMap {
    /// Expression (and unit) across, e.g. `theta [rad]`.
    pub x_label: String,
    /// Expression (and unit) upward.
    pub y_label: String,
    /// What the colour shows (and its unit).
    pub value_label: String,
    /// Coordinates across.
    pub x: Vec<f64>,
    /// Coordinates upward.
    pub y: Vec<f64>,
    /// Residual magnitude.
    pub value: Vec<f64>,
}

/// Points of the estimated missing force over its variable, and the law fitted to them.
#[derive(Debug, Clone, PartialEq)]
pub struct MechanismPlot {
    /// Index into `report.mechanisms`; `None` for the shape of what is unexplained.
    pub mechanism: Option<usize>,
    /// Heading of the plot.
    pub title: String,
    /// Variable (and unit) across.
    pub x_label: String,
    /// Force (and unit) upward.
    pub y_label: String,
    /// Estimates of the missing force from the data, (x, y).
    pub points: Vec<[f64; 2]>,
    /// The fitted law, (x, y) in drawing order; a NaN lifts the pen.
    pub curve: Vec<[f64; 2]>,
}

/// The model before and after.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct ModelTexts {
    /// The model as given.
    pub nominal: String,
    /// The improved model; empty where nothing changed.
    pub improved: String,
}
