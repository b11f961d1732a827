//! A document against its schema, and the schema against its checked-in copy.
#![allow(clippy::unwrap_used, reason = "helpers of tests panic like the tests themselves")]

use std::path::Path;

use serde_json::Value;

/// Asserts that a document satisfies a schema; the document as JSON.
pub(crate) fn assert_valid(document: &str, schema: &Value) -> Value {
    let json: Value = serde_json::from_str(document).unwrap();
    let validator = jsonschema::validator_for(schema).unwrap();
    let errors: Vec<String> =
        validator.iter_errors(&json).map(|e| format!("{}: {e}", e.instance_path())).collect();
    assert!(errors.is_empty(), "{errors:#?}");
    json
}

/// Asserts that `docs/<name>` is the generated schema; `UPDATE=1 cargo test -p greybox-report` rewrites it.
pub(crate) fn assert_current(name: &str, generated: &Value) {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs").join(name);
    if std::env::var_os("UPDATE").is_some() {
        let text = serde_json::to_string_pretty(generated).unwrap() + "\n";
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        std::fs::write(&path, text).unwrap();
    }
    let text = std::fs::read_to_string(&path)
        .unwrap_or_else(|e| panic!("docs/{name} cannot be read ({e}): run the tests with UPDATE=1"));
    let checked_in: Value = serde_json::from_str(&text).unwrap();
    assert_eq!(checked_in, *generated, "docs/{name} is stale: run the tests with UPDATE=1");
}
