//! Code with gaps.

/// `text` with each `@NAME@` replaced.
pub(super) fn fill(text: &str, gaps: &[(&str, &dyn std::fmt::Display)]) -> String {
    let mut out = text.to_owned();
    for (name, value) in gaps {
        out = out.replace(&format!("@{name}@"), &value.to_string());
    }
    out
}

/// `a, b, c`
pub(super) fn list(entries: impl IntoIterator<Item = String>) -> String {
    entries.into_iter().collect::<Vec<_>>().join(", ")
}
