//! From recordings and a nominal model to the finished diagnosis.

use std::sync::Arc;

use greybox_calibrate::{Setup, Work, free_parameters};
use greybox_model::Model;
use greybox_recording::Recording;

use crate::ProgressListener;
use crate::baseline::alone;
use crate::conclude::conclude;
use crate::diagnosis::{DiagnoseError, Diagnosis, Options};
use crate::layout::{Layout, layout};
use crate::library::built_in;
use crate::search::Search;

/// Diagnoses a model.
///
/// # Errors
/// [`DiagnoseError`] when the recordings do not fit the model or hold too little data.
pub fn diagnose(
    model: &Model,
    train: &[Recording],
    holdout: &[Recording],
    options: &Options,
    listener: &dyn ProgressListener,
) -> Result<Diagnosis, DiagnoseError> {
    let library = match &options.library {
        Some(library) => library.clone(),
        None => built_in()?,
    };
    let Layout { train, holdout, source } = layout(model, train, holdout)?;
    let laid_out = Setup::new(model, train.clone(), free_parameters(model))?;
    let nominal = Setup { work: Arc::new(Work::of_fits_within(options.work)), ..laid_out };
    listener.begins(&nominal.work);
    let mut search = Search::new(nominal.clone(), &library, listener);
    search.most_work = options.work;
    let found = match options.terms_only {
        true => alone(&nominal, false, options.work, listener),
        false => search.run(),
    };
    conclude(&nominal, (holdout, source), &search, found, options)
}
