//! An identification as files and words.

use greybox_identify::Identification;
use greybox_report::ReportError;
use greybox_report::convert::identification::{self as convert, MODEL_FILE, Sources};
use greybox_report::page;

use crate::failure::Failure;
use crate::story;

/// The files of an identification.
pub const FILES: [&str; 3] = ["report.json", "report.html", MODEL_FILE];

/// An identification as the files and words that users see.
#[derive(Debug)]
pub struct Results {
    /// `report.json`.
    pub report_json: String,
    /// `report.html`.
    pub report_html: String,
    /// `model.toml`.
    pub model_toml: String,
    /// The identification in plain language.
    pub story: String,
    /// The content of `report.json`.
    pub json: serde_json::Value,
    /// The recordings beside the free run of the identified model.
    pub recordings: Vec<page::Recording>,
}

impl Results {
    /// What is reported of a finished identification.
    ///
    /// # Errors
    /// An internal failure where the report cannot be written.
    pub fn of(found: &Identification, sources: &Sources<'_>) -> Result<Results, Failure> {
        let unwritten = |e: ReportError| Failure::internal(e.to_string());
        let report = convert::report(found, sources);
        let report_json = report.to_json().map_err(unwritten)?;
        let json = serde_json::from_str(&report_json).map_err(|e| unwritten(e.into()))?;
        let story = story::identification(&report);
        let page = convert::page(found, report);
        let report_html = page.to_html().map_err(unwritten)?;
        let model_toml = convert::model_toml(found);
        Ok(Results { report_json, report_html, model_toml, story, json, recordings: page.recordings })
    }

    /// The files, by name.
    pub fn files(&self) -> [(&'static str, &[u8]); 3] {
        let [json, html, model] = FILES;
        [
            (json, self.report_json.as_bytes()),
            (html, self.report_html.as_bytes()),
            (model, self.model_toml.as_bytes()),
        ]
    }
}

/// A stage in words.
pub fn stage_text(stage: &str) -> &str {
    match stage {
        "weak form" => "first estimates (weak form)",
        "output error" => "choosing and fitting terms on simulated outputs",
        "precision" => "intervals and resampled choices",
        other => other,
    }
}
