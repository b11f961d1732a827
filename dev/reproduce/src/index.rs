//! The folder of results: `index.html` for readers, `index.json` for machines, drawings and tables beside them.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::path::Path;

use anyhow::{Context, Result};
use greybox_report::expression::escape;
use serde_json::{Value, json};

use super::fixture::{Fixture, slug};
use super::{Outcome, Status, Table};

const STYLE: &str = "body{font:16px/1.5 system-ui,'Liberation Sans',sans-serif;color:#1d232b;margin:0 auto;\
max-width:960px;padding:28px;font-variant-numeric:tabular-nums}h1{margin:0 0 6px;font-size:28px}\
h2{margin:0;font-size:20px}section{border-top:1px solid #dfe3e8;padding:22px 0 26px}\
.soft{color:#5a6472;font-size:14.5px}p{margin:6px 0 10px;max-width:80ch}\
.badge{display:inline-block;font-size:13px;font-weight:600;border-radius:3px;padding:1px 8px;margin-left:10px;\
color:#fff;vertical-align:3px}.reproduced{background:#2c7a4b}.virtual_rig{background:#0b6fa8}\
.constants{background:#5a6472}.differs{background:#7a4fa0}.none{background:#b98a00}.failed{background:#b3401f}\
.scroll{overflow-x:auto}table{border-collapse:collapse;margin:10px 0 14px;font-size:14.5px}\
caption{text-align:left;color:#5a6472;padding-bottom:4px}th,td{padding:3px 14px 3px 0;text-align:right;\
border-bottom:1px solid #e9ecf0;vertical-align:top}td{white-space:nowrap}td.text,.own td:first-child{white-space:normal}th:first-child,td:first-child,.text{text-align:left}\
th{font-weight:600;border-color:#8b95a3}.ours{color:#0b6fa8;font-weight:600}figure{margin:12px 0}\
figcaption{color:#5a6472;font-size:14.5px}.errata{font-size:14.5px;background:#f5f7f9;padding:8px 14px;\
border-radius:4px;margin:10px 0}.errata p{margin:3px 0}.failures{color:#b3401f;font-weight:600}\
a{color:#0b6fa8}svg.plot{max-width:100%;height:auto}nav{columns:2;margin:12px 0 26px}nav div{margin:1px 0}";

/// Writes the folder.
///
/// # Errors
/// When a file cannot be written.
pub(crate) fn write(
    out: &Path,
    outcomes: &[Outcome],
    missing: &[Fixture],
    errata: &BTreeMap<String, String>,
) -> Result<()> {
    let mut entries = Vec::new();
    for outcome in outcomes {
        let mut files = Vec::new();
        let name = slug(&outcome.fixture.id);
        let mut add = |file: String, text: &str| -> Result<()> {
            save(&out.join(&file), text)?;
            files.push(file);
            Ok(())
        };
        add(format!("tables/{name}.json"), &format!("{:#}\n", table_json(outcome)))?;
        for (k, figure) in outcome.piece.figures.iter().enumerate() {
            let part = if outcome.piece.figures.len() > 1 { format!("-{}", k + 1) } else { String::new() };
            add(format!("figures/{name}{part}.svg"), &figure.svg)?;
        }
        entries.push(json!({
            "id": outcome.fixture.id, "status": outcome.piece.status.name(),
            "why": outcome.piece.why, "files": files,
        }));
    }
    save(&out.join("index.json"), &format!("{:#}\n", Value::Array(entries)))?;
    save(&out.join("index.html"), &page(outcomes, missing, errata))
}

fn save(path: &Path, text: &str) -> Result<()> {
    if let Some(folder) = path.parent() {
        std::fs::create_dir_all(folder).with_context(|| format!("{} cannot be made", folder.display()))?;
    }
    std::fs::write(path, text).with_context(|| format!("{} cannot be written", path.display()))
}

/// The thesis's rows with our columns, our tables, and what was judged.
fn table_json(outcome: &Outcome) -> Value {
    let (fixture, piece) = (&outcome.fixture, &outcome.piece);
    let ours: Vec<Value> = piece
        .columns
        .iter()
        .map(|c| {
            let rows: Vec<Value> =
                c.values.iter().map(|(name, value)| json!({"name": name, "value": value})).collect();
            json!({"title": c.title, "rows": rows})
        })
        .collect();
    let tables: Vec<Value> = piece
        .tables
        .iter()
        .map(|t| json!({"caption": t.caption, "headings": t.headings, "rows": t.rows}))
        .collect();
    let checks: Vec<Value> = piece
        .checks
        .iter()
        .map(|c| json!({"name": c.name, "measured": c.measured, "bounds": fixture.bounds.get(&c.name)}))
        .collect();
    json!({
        "id": fixture.id, "title": fixture.title, "source": fixture.source, "errata": fixture.errata,
        "status": piece.status.name(), "why": piece.why, "thesis": fixture.rows, "ours": ours,
        "tables": tables, "checks": checks, "failures": outcome.failures,
    })
}

fn page(outcomes: &[Outcome], missing: &[Fixture], errata: &BTreeMap<String, String>) -> String {
    let mut out = format!(
        "<!doctype html><html lang=\"en\"><head><meta charset=\"utf-8\">\
         <meta name=\"viewport\" content=\"width=device-width\"><title>Reproduction</title>\
         <style>{STYLE}</style></head><body><h1>The thesis, made again</h1>\
         <p class=\"soft\">Tables and figures of the thesis (Leylaz, UC Merced 2021) beside what greybox makes of \
         them. Numbers of ours are blue. <b>Reproduced</b>: the same experiment, run again. <b>Virtual rig</b>: the \
         recordings are not public, a simulated rig takes their place. <b>Constants</b>: data-sheet values and what \
         follows from them. <b>Differs</b>: cannot be made again, or comes out differently. Errata correct what is \
         printed.</p><nav>"
    );
    for outcome in outcomes {
        let _ = write!(out, "<div>{}{}</div>", link(&outcome.fixture), badge(outcome.piece.status));
    }
    for fixture in missing {
        let _ = write!(out, "<div>{}<span class=\"badge none\">not made yet</span></div>", link(fixture));
    }
    out.push_str("</nav>");
    for outcome in outcomes {
        section(&mut out, outcome, errata);
    }
    for fixture in missing {
        heading(&mut out, fixture, "<span class=\"badge none\">not made yet</span>");
        thesis_table(&mut out, fixture, None);
        notes(&mut out, fixture, errata);
        out.push_str("</section>");
    }
    out.push_str("</body></html>\n");
    out
}

fn link(fixture: &Fixture) -> String {
    format!("<a href=\"#{}\">{}</a>", slug(&fixture.id), escape(&fixture.id))
}

fn badge(status: Status) -> String {
    format!("<span class=\"badge {}\">{}</span>", status.name(), status.name().replace('_', " "))
}

fn heading(out: &mut String, fixture: &Fixture, badge: &str) {
    let _ = write!(
        out,
        "<section id=\"{}\"><h2>{}{badge}</h2><p>{}.{}</p>",
        slug(&fixture.id),
        escape(&fixture.id),
        escape(&fixture.title),
        match fixture.source.as_str() {
            "" => String::new(),
            source => format!(" <span class=\"soft\">Thesis, {}.</span>", escape(source)),
        }
    );
}

fn section(out: &mut String, outcome: &Outcome, errata: &BTreeMap<String, String>) {
    let (fixture, piece) = (&outcome.fixture, &outcome.piece);
    let failed =
        if outcome.failures.is_empty() { "" } else { "<span class=\"badge failed\">out of bounds</span>" };
    heading(out, fixture, &format!("{}{failed}", badge(piece.status)));
    let _ = write!(out, "<p>{}</p>", escape(&piece.why));
    for failure in &outcome.failures {
        let _ = write!(out, "<p class=\"failures\">{}</p>", escape(failure));
    }
    for figure in &piece.figures {
        let _ = write!(
            out,
            "<figure>{}<figcaption>{}</figcaption></figure>",
            figure.svg,
            escape(&figure.caption)
        );
    }
    thesis_table(out, fixture, Some(outcome));
    for table in &piece.tables {
        our_table(out, table);
    }
    if !piece.checks.is_empty() {
        let rows = piece.checks.iter().map(|c| {
            let bounds =
                fixture.bounds.get(&c.name).map_or_else(String::new, |b| b.to_string().replace('-', "−"));
            vec![c.name.clone(), number(c.measured), bounds]
        });
        let headings = ["judged".into(), "measured".into(), "bounds".into()].into();
        our_table(out, &Table { caption: "Regression bounds".into(), headings, rows: rows.collect() });
    }
    notes(out, fixture, errata);
    out.push_str("</section>");
}

/// The thesis's rows, with our columns where there is an outcome.
fn thesis_table(out: &mut String, fixture: &Fixture, outcome: Option<&Outcome>) {
    if fixture.rows.is_empty() {
        return;
    }
    let ours = outcome.map_or(&[][..], |o| &o.piece.columns[..]);
    let remarks = fixture.rows.iter().any(|row| row.contains_key("note") || row.contains_key("erratum"));
    out.push_str("<div class=\"scroll\"><table><tr><th></th>");
    for column in &fixture.columns {
        let _ = write!(out, "<th>{}</th>", escape(&column.title));
    }
    for column in ours {
        let _ = write!(out, "<th class=\"ours\">{}</th>", escape(&column.title));
    }
    out.push_str(if remarks { "<th class=\"text\">remark</th></tr>" } else { "</tr>" });
    for row in &fixture.rows {
        let text = |key: &str| row.get(key).and_then(Value::as_str).unwrap_or("");
        let _ = write!(out, "<tr><td>{}</td>", escape(text("name")));
        for column in &fixture.columns {
            let _ = write!(out, "<td>{}</td>", escape(&cell(row.get(&column.key))));
        }
        for column in ours {
            let value = column.values.iter().find(|(name, _)| name == text("name"));
            let _ =
                write!(out, "<td class=\"ours\">{}</td>", value.map_or_else(String::new, |v| number(v.1)));
        }
        if remarks {
            let parts = [text("erratum"), text("note")];
            let remark: Vec<&str> = parts.into_iter().filter(|part| !part.is_empty()).collect();
            let _ = write!(out, "<td class=\"text soft\">{}</td>", escape(&remark.join(": ")));
        }
        out.push_str("</tr>");
    }
    out.push_str("</table></div>");
}

fn our_table(out: &mut String, table: &Table) {
    let _ = write!(
        out,
        "<div class=\"scroll\"><table class=\"own\"><caption>{}</caption><tr>",
        escape(&table.caption)
    );
    for heading in &table.headings {
        let _ = write!(out, "<th>{}</th>", escape(heading));
    }
    out.push_str("</tr>");
    for row in &table.rows {
        out.push_str("<tr>");
        for cell in row {
            let _ = write!(out, "<td>{}</td>", escape(cell));
        }
        out.push_str("</tr>");
    }
    out.push_str("</table></div>");
}

fn notes(out: &mut String, fixture: &Fixture, errata: &BTreeMap<String, String>) {
    for note in &fixture.notes {
        let _ = write!(out, "<p class=\"soft\">{}</p>", escape(note));
    }
    let mut named: Vec<&str> = fixture.named_errata().collect();
    named.sort_by_key(|id| id.trim_start_matches('E').parse::<u32>().unwrap_or(u32::MAX));
    named.dedup();
    if named.is_empty() {
        return;
    }
    out.push_str("<div class=\"errata\">");
    for id in named {
        let text = errata.get(id).map_or("", String::as_str);
        let _ = write!(out, "<p><b>{}</b> {}</p>", escape(id), escape(text));
    }
    out.push_str("</div>");
}

fn cell(value: Option<&Value>) -> String {
    match value {
        None | Some(Value::Null) => "–".into(),
        Some(Value::String(text)) => text.clone(),
        Some(Value::Number(n)) => n.as_f64().map_or_else(|| n.to_string(), printed),
        Some(other) => other.to_string(),
    }
}

/// A number of the thesis, with the digits that it has.
fn printed(value: f64) -> String {
    let small = value != 0.0 && value.abs() < 1e-3;
    if small { format!("{value:e}") } else { value.to_string() }.replace('-', "−")
}

/// A number of ours, to five figures; whole numbers without decimals.
pub(crate) fn number(value: f64) -> String {
    if value.fract() == 0.0 && value.abs() < 1e6 {
        return format!("{value:.0}").replace('-', "−");
    }
    let decimals = (4.0 - value.abs().log10().floor()).clamp(0.0, 12.0) as usize;
    if value.abs() < 1e-3 || value.abs() >= 1e6 || !value.is_finite() {
        return format!("{value:.4e}").replace('-', "−");
    }
    format!("{value:.decimals$}").replace('-', "−")
}
