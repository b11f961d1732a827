//! A controller that was designed and simulated.

use greybox_control::{Controller, Family, OutputFeedback, Run};
use greybox_model::Model;

/// What the files are written from.
#[derive(Clone, Copy)]
pub(super) struct Designed<'a> {
    pub(super) model: &'a Model,
    /// File name of the model.
    pub(super) file: &'a str,
    pub(super) controller: &'a Controller,
    /// The observer, where the law is not given the full state.
    pub(super) output: Option<&'a OutputFeedback>,
    /// Of the loop, beside the model's, s.
    pub(super) delay: f64,
    /// The command under which the observer starts at the machine; at zero where there is none.
    pub(super) held: Option<f64>,
    pub(super) run: &'a Run,
    pub(super) family: Option<&'a Family>,
}
