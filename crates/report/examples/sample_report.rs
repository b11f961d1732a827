//! Writes a sample page and its JSON: `cargo run -p greybox-report --example sample_report -- OUT.html`.

use std::error::Error;
use std::path::PathBuf;

mod sample;

fn main() -> Result<(), Box<dyn Error>> {
    let out = std::env::args_os().nth(1).map(PathBuf::from).ok_or("usage: sample_report OUT.html")?;
    let page = sample::page();
    std::fs::write(out.with_extension("json"), page.report.to_json()?)?;
    std::fs::write(&out, page.to_html()?)?;
    Ok(())
}
