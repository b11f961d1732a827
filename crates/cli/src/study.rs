//! Arguments that subcommands share: the recordings and the model of a study, and where its results go.

use std::path::{Path, PathBuf};

use clap::Args;

use crate::case::{CaseOptions, Subject};
use crate::channels::Channels;
use crate::failure::Failure;
use crate::loading::{self, LoadedModel, Wanted};
use crate::output::OutputFolder;
use greybox_calibrate::Data;
use greybox_recording::Recording;

/// The unit of `--work`, in operations.
pub(crate) const BILLION: u64 = 1_000_000_000;

/// A seed, or an amount of work.
pub(crate) fn whole(text: &str) -> Result<u64, String> {
    text.parse().map_err(|_| format!("write a whole number from 0 to {}, such as 7", u64::MAX))
}

/// The recordings of a command that learns from some and is judged on others, and where its results go.
#[derive(Debug, Args)]
pub(crate) struct Study {
    /// Recordings to choose and fit with (CSV, MAT-file, HDF5, NumPy, MCAP or Parquet)
    #[arg(value_name = "TRAIN.csv", required = true)]
    pub(crate) train: Vec<PathBuf>,

    /// Recordings that only judge the result
    #[arg(long, value_name = "TEST.csv", num_args = 1..)]
    pub(crate) holdout: Vec<PathBuf>,

    #[command(flatten)]
    pub(crate) channels: Channels,

    /// Folder for the results; made where it is missing
    #[arg(long, value_name = "DIR")]
    pub(crate) out: PathBuf,

    #[command(flatten)]
    pub(crate) case: CaseOptions,
}

/// What a [`Study`] reads.
#[derive(Debug)]
pub(crate) struct Recordings {
    pub(crate) train: Vec<Recording>,
    pub(crate) holdout: Vec<Recording>,
}

impl Study {
    /// Reads what is wanted of the recordings.
    ///
    /// # Errors
    /// As [`loading::train_and_holdout`].
    pub(crate) fn recordings(&self, wanted: &Wanted) -> Result<Recordings, Failure> {
        let (train, holdout) = loading::train_and_holdout(&self.train, &self.holdout, wanted)?;
        Ok(Recordings { train, holdout })
    }

    /// Reads a model and the recordings, and sees that they fit each other.
    ///
    /// # Errors
    /// Bad input: a file that cannot be read, or a recording that lacks what the model needs.
    pub(crate) fn read(&self, model: &Path) -> Result<(LoadedModel, Recordings), Failure> {
        let loaded = loading::model(model)?;
        let recordings = self.recordings(&self.channels.wanted().of_model(&loaded.model))?;
        Data::new(&loaded.model, &recordings.train)?;
        Data::new(&loaded.model, &recordings.holdout)?;
        Ok((loaded, recordings))
    }

    /// What a case of it holds: its files, and the names of its results.
    pub(crate) fn subject<'a>(&'a self, files: &'a [&'a str]) -> Subject<'a> {
        Subject {
            model: None,
            train: &self.train,
            holdout: &self.holdout,
            read: &self.channels,
            mechanisms: None,
            channels: (&[], &[]),
            out: &self.out,
            files,
        }
    }

    /// The folder for `results`, none of which may replace an input.
    ///
    /// # Errors
    /// As [`OutputFolder::prepare`] and [`OutputFolder::spares`].
    pub(crate) fn folder<'a>(
        &'a self,
        results: &[&str],
        others: impl IntoIterator<Item = &'a PathBuf>,
    ) -> Result<OutputFolder, Failure> {
        let out = OutputFolder::prepare(&self.out)?;
        out.spares(results, self.train.iter().chain(&self.holdout).chain(others))?;
        Ok(out)
    }
}

/// A [`Study`] of a model.
#[derive(Debug, Args)]
pub(crate) struct ModelStudy {
    /// Nominal model (TOML)
    #[arg(value_name = "MODEL.toml")]
    pub(crate) model: PathBuf,

    #[command(flatten)]
    pub(crate) study: Study,
}

impl ModelStudy {
    /// As [`Study::read`].
    ///
    /// # Errors
    /// As [`Study::read`].
    pub(crate) fn read(&self) -> Result<(LoadedModel, Recordings), Failure> {
        self.study.read(&self.model)
    }

    /// As [`Study::folder`]; the model is an input too.
    ///
    /// # Errors
    /// As [`Study::folder`].
    pub(crate) fn folder(&self, results: &[&str]) -> Result<OutputFolder, Failure> {
        self.study.folder(results, [&self.model])
    }
}
