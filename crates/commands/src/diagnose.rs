//! A diagnosis as files and words.

use greybox_diagnose::{Diagnosis, Stage, Weighed};
use greybox_recording::Recording;
use greybox_report::ReportError;
use greybox_report::convert::{self, Sources};
use greybox_report::page;

use crate::failure::Failure;
use crate::loading::LoadedModel;
use crate::story;

/// The files of a diagnosis.
pub const FILES: [&str; 3] = ["report.json", "report.html", "improved.toml"];

/// A diagnosis as the files and words that users see.
#[derive(Debug)]
pub struct Results {
    /// `report.json`.
    pub report_json: String,
    /// `report.html`.
    pub report_html: String,
    /// `improved.toml`.
    pub improved_toml: String,
    /// The diagnosis in plain language.
    pub story: String,
    /// The content of `report.json`.
    pub json: serde_json::Value,
    /// The recordings beside the free runs of the three models.
    pub recordings: Vec<page::Recording>,
}

impl Results {
    /// What is reported of a finished diagnosis of these recordings.
    ///
    /// # Errors
    /// An internal failure where the report cannot be written.
    pub fn of(
        diagnosis: &Diagnosis,
        loaded: &LoadedModel,
        train: &[Recording],
        holdout: &[Recording],
    ) -> Result<Results, Failure> {
        let sources = Sources { model_file: &loaded.file, model_text: &loaded.text, train, holdout };
        let report = convert::report(diagnosis, &sources);
        let report_json = report.to_json().map_err(unwritten)?;
        let json = serde_json::from_str(&report_json).map_err(|e| unwritten(e.into()))?;
        let story = story::diagnosis(&report);
        let page = convert::page(diagnosis, report, &sources);
        let report_html = page.to_html().map_err(unwritten)?;
        let improved_toml = convert::improved_toml(diagnosis, &loaded.text);
        Ok(Results { report_json, report_html, improved_toml, story, json, recordings: page.recordings })
    }

    /// The files, by name.
    pub fn files(&self) -> [(&'static str, &[u8]); 3] {
        let [json, html, toml] = FILES;
        [
            (json, self.report_json.as_bytes()),
            (html, self.report_html.as_bytes()),
            (toml, self.improved_toml.as_bytes()),
        ]
    }
}

fn unwritten(error: ReportError) -> Failure {
    Failure::internal(error.to_string())
}

/// A stage in words.
pub fn stage_text(stage: Stage) -> String {
    match stage {
        Stage::Calibrating => "calibrating the model as it is".to_owned(),
        Stage::Screening { candidates, found } => {
            format!("screening {candidates} candidates ({found} found so far)")
        }
        Stage::Fitting { candidates } => format!("fitting the best {candidates}"),
        Stage::Lengthening { segments } => format!("going on with {segments} longer segments"),
        Stage::Whitening => "searching again with coloured noise modelled".to_owned(),
        Stage::Simulating => "fitting whole recordings".to_owned(),
        Stage::Closing { length, terms } => {
            format!("choosing terms of a formula on {length} samples at a time ({terms} so far)")
        }
        Stage::Validating => "predicting recordings that are left out".to_owned(),
        Stage::Exploring => "weighing laws beside an error of the model".to_owned(),
        Stage::Concluding => "estimating intervals and shares".to_owned(),
    }
}

/// What was weighed in words: by what decides, and by what is to take its place.
pub fn told_weighed(weighed: &Weighed<'_>) -> String {
    format!(
        "{}: score {:.1}, robust {:.1}, threshold {:.1}: {}",
        weighed.kinds.join(" and "),
        weighed.evidence.score,
        (weighed.robust)(),
        weighed.threshold,
        if weighed.believed { "accepted" } else { "not believed" }
    )
}
