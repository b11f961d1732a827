//! What `greybox demo link` diagnoses.

use anyhow::Result;
use greybox_diagnose::{Diagnosis, Options, Quiet, diagnose};
use greybox_model::Model;
use greybox_recording::{Recording, read_csv};

/// The embedded model and its recordings.
pub struct Demo {
    /// The maker's model of the link.
    pub model: Model,
    /// What it is fitted to.
    pub train: [Recording; 1],
    /// What judges the fit.
    pub holdout: [Recording; 1],
}

impl Demo {
    /// Reads them from the sources of the command.
    ///
    /// # Errors
    /// When a file cannot be read.
    pub fn read() -> Result<Self> {
        let folder = crate::root().join("crates").join("cli").join("demo");
        let path = folder.join("rotary_link.toml");
        let recording = |name: &str| -> Result<_> { Ok([read_csv(folder.join(name))?]) };
        Ok(Self {
            model: Model::from_toml(&std::fs::read_to_string(&path)?, "rotary_link.toml")?,
            train: recording("rotary_link_train.csv")?,
            holdout: recording("rotary_link_test.csv")?,
        })
    }

    /// What `greybox demo link` does with them.
    ///
    /// # Errors
    /// Those of [`diagnose`].
    pub fn diagnose(&self) -> Result<Diagnosis> {
        Ok(diagnose(&self.model, &self.train, &self.holdout, &Options::default(), &Quiet)?)
    }
}
