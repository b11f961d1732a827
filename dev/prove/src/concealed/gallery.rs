//! The suite as one page: a card per case with truth, verdict and the held-out recording.

use std::fmt::Write as _;

use super::Finished;
use super::summary;

/// Points of a curve, at most.
const POINTS: usize = 360;
const WIDTH: f64 = 420.0;
const HEIGHT: f64 = 150.0;

/// One channel of the held-out recording.
pub(crate) struct Curves {
    pub(crate) channel: String,
    pub(crate) dt: f64,
    pub(crate) measured: Vec<f64>,
    /// Free runs; empty where there is none.
    pub(crate) calibrated: Vec<f64>,
    pub(crate) improved: Vec<f64>,
}

/// The page. It needs nothing from elsewhere; links lead to the reports beside it.
pub(crate) fn render(seed: u64, finished: &[Finished], figures: &summary::Figures) -> String {
    let mut page = String::from(
        "<!doctype html>\n<html lang=\"en\"><head><meta charset=\"utf-8\"><title>The concealed suite</title>\n<style>\n\
         :root{color-scheme:light dark}\n\
         body{font:14px/1.45 system-ui,sans-serif;margin:2rem auto;max-width:1360px;padding:0 1rem}\n\
         main{display:grid;grid-template-columns:repeat(auto-fill,minmax(440px,1fr));gap:1rem}\n\
         article{border:1px solid #8886;border-left:6px solid #2a9d4a;border-radius:6px;padding:.7rem 1rem;min-width:0}\n\
         article.miss{border-left-color:#c0392b}\n\
         h2{font-size:1rem;margin:0}\n\
         p{margin:.3rem 0;overflow-wrap:anywhere}\n\
         pre{overflow:auto;font-size:12px}\n\
         svg{width:100%;height:auto;display:block}\n\
         .m{stroke:#8889;stroke-width:2.4}.c{stroke:#d9822b;stroke-dasharray:4 3}.i{stroke:#1f6fb2}\n\
         polyline{fill:none;stroke-width:1.2}\n\
         .tag{display:inline-block;border:1px solid #8888;border-radius:9px;padding:0 .5em;margin-right:.3em;font-size:12px}\n\
         </style></head><body>\n",
    );
    let right = finished.iter().filter(|f| f.score.right()).count();
    let _ = writeln!(
        page,
        "<h1>The concealed suite, seed {seed}</h1>\n<p>{right} of {} cases right. Held-out recordings: measured \
         (grey), calibrated (dashed orange), improved (blue).</p>\n<details><summary>Tables and goals</summary>\
         <pre>{}</pre></details>\n<main>",
        finished.len(),
        escape(&summary::render(finished, figures))
    );
    finished.iter().for_each(|f| card(&mut page, f));
    page.push_str("</main></body></html>\n");
    page
}

fn card(page: &mut String, f: &Finished) {
    let (t, s) = (&f.truth, &f.score);
    let class = if s.right() { "" } else { " class=\"miss\"" };
    let _ = writeln!(page, "<article{class}><h2>{} · {}</h2><p>", escape(&t.id), escape(t.system));
    let tags = [t.class].into_iter().chain(t.tier.map(|t| t.name())).chain(t.masks.iter().map(|m| m.name()));
    for tag in tags {
        let _ = write!(page, "<span class=\"tag\">{}</span>", escape(tag));
    }
    page.push_str("</p>\n<p><b>Left out:</b> ");
    if t.effects.is_empty() {
        page.push_str("nothing");
    }
    for (i, e) in t.effects.iter().enumerate() {
        let parameters: Vec<String> = e.parameters.iter().map(|(n, x)| format!("{n} = {x:.4}")).collect();
        let _ = write!(
            page,
            "{}{} ({}), {:.1} × noise",
            if i > 0 { "; " } else { "" },
            escape(e.kind),
            escape(&parameters.join(", ")),
            e.severity
        );
    }
    let said = match &s.failure {
        Some(why) => why.clone(),
        None if s.found.is_empty() => s.verdict.clone(),
        None => format!("{}: {}", s.verdict, s.found.join(", ")),
    };
    let _ = writeln!(page, "</p>\n<p><b>Found:</b> {}</p>", escape(&said));
    let held = s.holdout.map_or("–".to_owned(), |r| format!("{r:.2}"));
    let _ = writeln!(
        page,
        "<p>Held-out error {held} × oracle · {:.1} s{}</p>",
        s.seconds,
        if s.failure.is_none() {
            // The name is of hexadecimal digits.
            format!(" · <a href=\"out/{}/report.html\">report</a>", t.id)
        } else {
            String::new()
        }
    );
    f.curves.iter().for_each(|c| page.push_str(&figure(c)));
    let _ = writeln!(
        page,
        "<details><summary>Models</summary><pre>{}</pre><pre>{}</pre></details></article>",
        escape(&f.models[0]),
        escape(&f.models[1])
    );
}

fn figure(c: &Curves) -> String {
    // Runs that leave the page do not decide its scale.
    let (low, high) =
        c.measured.iter().fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), &x| (l.min(x), h.max(x)));
    let room = 0.15 * (high - low).max(f64::MIN_POSITIVE);
    let (low, high) = (low - room, high + room);
    let n = c.measured.len().max(2);
    let points = |y: &[f64]| {
        let step = n.div_ceil(POINTS).max(1);
        let mut text = String::new();
        for (k, &x) in y.iter().enumerate().step_by(step).filter(|(_, x)| x.is_finite()) {
            let px = WIDTH * k as f64 / (n - 1) as f64;
            let py = (HEIGHT * (high - x) / (high - low)).clamp(-HEIGHT, 2.0 * HEIGHT);
            let _ = write!(text, "{px:.1},{py:.1} ");
        }
        text
    };
    let line =
        |class: &str, y: &[f64]| format!("<polyline class=\"{class}\" points=\"{}\"/>", points(y).trim_end());
    format!(
        "<figure style=\"margin:.4rem 0\"><svg viewBox=\"0 0 {WIDTH} {HEIGHT}\" role=\"img\" aria-label=\"{0}\">{1}{2}{3}</svg>\
         <figcaption>{0}, {4:.2} s</figcaption></figure>\n",
        escape(&c.channel),
        line("m", &c.measured),
        line("c", &c.calibrated),
        line("i", &c.improved),
        n as f64 * c.dt
    )
}

/// Text that HTML takes as text.
fn escape(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}

/// A column of a CSV by the name before its unit; empty cells are NaN. `None` where there is none.
pub(crate) fn column(csv: &str, name: &str) -> Option<Vec<f64>> {
    let mut lines = csv.lines();
    let at = lines.next()?.split(',').position(|h| h.split('[').next().unwrap_or(h).trim() == name)?;
    Some(
        lines.map(|l| l.split(',').nth(at).and_then(|c| c.trim().parse().ok()).unwrap_or(f64::NAN)).collect(),
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn columns_are_found_by_name() {
        let csv = "t [s],theta [rad],x\n0,1.5,2\n1,,3\n";
        assert_eq!(column(csv, "x"), Some(vec![2.0, 3.0]));
        let theta = column(csv, "theta").unwrap();
        assert!(theta[0] == 1.5 && theta[1].is_nan());
        assert_eq!(column(csv, "y"), None);
    }

    #[test]
    fn nothing_from_a_case_becomes_markup() {
        assert_eq!(escape("<b a=\"1\">&"), "&lt;b a=&quot;1&quot;&gt;&amp;");
        let curves = Curves {
            channel: "<x>".into(),
            dt: 0.1,
            measured: vec![0.0, 1.0, f64::NAN],
            calibrated: vec![],
            improved: vec![0.0, f64::INFINITY, 1e300],
        };
        let svg = figure(&curves);
        assert!(!svg.contains("<x>") && !svg.contains("NaN") && !svg.contains("inf"), "{svg}");
    }
}
