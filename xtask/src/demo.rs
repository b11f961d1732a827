//! What `greybox demo` diagnoses.

use anyhow::Result;
use greybox_diagnose::{Diagnosis, Options, Quiet, diagnose};
use greybox_model::Model;
use greybox_recording::{Recording, read_csv};

/// The embedded model and its recordings.
pub(crate) struct Demo {
    pub(crate) model: Model,
    pub(crate) train: [Recording; 1],
    pub(crate) holdout: [Recording; 1],
}

impl Demo {
    pub(crate) fn read() -> Result<Self> {
        let folder = crate::root().join("crates").join("cli").join("demo");
        let path = folder.join("rotary_link.toml");
        let recording = |name: &str| -> Result<_> { Ok([read_csv(folder.join(name))?]) };
        Ok(Self {
            model: Model::from_toml(&std::fs::read_to_string(&path)?, "rotary_link.toml")?,
            train: recording("rotary_link_train.csv")?,
            holdout: recording("rotary_link_test.csv")?,
        })
    }

    pub(crate) fn diagnose(&self) -> Result<Diagnosis> {
        Ok(diagnose(&self.model, &self.train, &self.holdout, &Options::default(), &Quiet)?)
    }
}
