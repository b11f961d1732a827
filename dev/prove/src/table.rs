//! The table of figures as text.

use super::Outcome;

/// All figures, one line each, in columns as wide as their widest cell.
pub(crate) fn render(outcomes: &[Outcome]) -> String {
    let mut rows: Vec<[String; 5]> = vec![["case", "figure", "measured", "goal", ""].map(str::to_owned)];
    for outcome in outcomes {
        for (i, f) in outcome.figures.iter().enumerate() {
            let case = if i == 0 { outcome.case.clone() } else { String::new() };
            let mark = match f.met {
                Some(true) => "met",
                Some(false) => "MISSED",
                None => "",
            };
            rows.push([case, f.name.clone(), f.measured.clone(), f.goal.clone(), mark.to_owned()]);
        }
    }
    let width = |c: usize| rows.iter().map(|r| r[c].chars().count()).max().unwrap_or(0);
    let widths: Vec<usize> = (0..5).map(width).collect();
    let line = |row: &[String; 5]| {
        let cells: Vec<String> = row.iter().zip(&widths).map(|(cell, &w)| format!("{cell:<w$}")).collect();
        cells.join("  ").trim_end().to_owned() + "\n"
    };
    let rule = widths.iter().map(|&w| "-".repeat(w)).collect::<Vec<_>>().join("  ");
    let mut text = line(&rows[0]);
    text.push_str(rule.trim_end());
    text.push('\n');
    rows[1..].iter().for_each(|row| text.push_str(&line(row)));
    text
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Figure;

    #[test]
    fn columns_line_up_and_the_case_stands_once() {
        let figures = vec![Figure::plain("µ", "1"), Figure::judged("time", "12 s", "< 9 s", false)];
        let text = render(&[Outcome { case: "a".into(), figures }]);
        assert_eq!(
            text,
            "case  figure  measured  goal\n\
             ----  ------  --------  -----  ------\n\
             a     µ       1\n      \
                   time    12 s      < 9 s  MISSED\n"
        );
    }
}
