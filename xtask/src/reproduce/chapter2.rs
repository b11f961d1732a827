//! Chapter 2: identification by the algebraic method.

use std::fmt::Write as _;

use anyhow::Result;

use super::figure::open;
use super::fixture::Fixture;
use super::index::number;
use super::{Check, Column, Drawing, Entry, Piece, Status, Table};

/// Its tables and figures, in order.
pub(crate) fn entries() -> Vec<Entry> {
    vec![
        Entry { id: "Figure 2.1", make: Some(figure_2_1) },
        Entry { id: "Table 2.1", make: None },
        Entry { id: "Figure 2.2", make: None },
        Entry { id: "Figure 2.3", make: None },
        Entry { id: "Figure 2.4", make: Some(photograph) },
        Entry { id: "Table 2.2", make: Some(table_2_2) },
        Entry { id: "Table 2.3", make: Some(table_2_3) },
        Entry { id: "Figure 2.5", make: None },
        Entry { id: "Figure 2.6", make: None },
        Entry { id: "Figure 2.7", make: None },
    ]
}

/// A photograph of a rig.
pub(crate) fn photograph(_: &Fixture) -> Result<Piece> {
    Ok(Piece::new(
        Status::Differs,
        "A photograph of the experiment: there is nothing to compute, and it is not ours to copy.",
    ))
}

/// Rows of fold k when n rows in time are cut into K contiguous folds, as even as they can be.
fn fold(n: usize, folds: usize, k: usize) -> std::ops::Range<usize> {
    k * n / folds..(k + 1) * n / folds
}

/// Figure 2.1: contiguous folds, drawn from the cut itself.
fn figure_2_1(fixture: &Fixture) -> Result<Piece> {
    let folds = fixture.number("folds of the numerical example", "thesis")? as usize;
    let rows = 30_000;
    let (left, width, height) = (92.0, 612.0, 26.0);
    let mut svg = open(720.0, 62.0 + 32.0 * folds as f64, "Contiguous folds: each validates once");
    for validating in 0..folds {
        let y = 34.0 + 32.0 * validating as f64;
        let _ = write!(svg, "<text x=\"4\" y=\"{:.1}\">model {}</text>", y + 18.0, validating + 1);
        for k in 0..folds {
            let range = fold(rows, folds, k);
            let place = |row: usize| left + width * row as f64 / rows as f64;
            let (from, to) = (place(range.start), place(range.end));
            let (fill, ink, text) = if k == validating {
                ("#d55e00", "#fff", "validation")
            } else {
                ("#dcecf6", "#1d232b", "training")
            };
            let _ = write!(
                svg,
                "<rect x=\"{from:.1}\" y=\"{y}\" width=\"{:.1}\" height=\"{height}\" fill=\"{fill}\"/>\
                 <text x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"middle\" fill=\"{ink}\">{text}</text>",
                to - from - 2.0,
                0.5 * (from + to) - 1.0,
                y + 18.0
            );
        }
    }
    for k in 0..folds {
        let range = fold(rows, folds, k);
        let middle = left + width * 0.5 * (range.start + range.end) as f64 / rows as f64;
        let _ = write!(svg, "<text x=\"{middle:.1}\" y=\"22\" text-anchor=\"middle\">{}</text>", k + 1);
    }
    let _ = write!(
        svg,
        "<text class=\"axis\" x=\"{}\" y=\"{}\" text-anchor=\"middle\">rows in the order of time →</text></svg>",
        left + 0.5 * width,
        54.0 + 32.0 * folds as f64
    );

    // An uneven number of rows, where a careless cut shows.
    let sizes: Vec<usize> = (0..folds).map(|k| fold(rows - 1, folds, k).len()).collect();
    let spread = sizes.iter().max().zip(sizes.iter().min()).map_or(0, |(most, least)| most - least);
    let mut piece = Piece::new(
        Status::Reproduced,
        "Redrawn from the cut into folds. Folds are contiguous: neighbouring rows share most of their data, and \
         random folds leak.",
    );
    piece.figures.push(Drawing {
        caption: "Each of the K models is trained on K − 1 folds and validated on the one left out.".into(),
        svg,
    });
    piece.checks.push(Check::new(
        "rows covered by the folds",
        sizes.iter().sum::<usize>() as f64 / (rows - 1) as f64,
    ));
    piece.checks.push(Check::new("rows between the largest and the smallest fold", spread as f64));
    Ok(piece)
}

/// Constants of the rotary flexible beam (equations 2.20 and 2.21).
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Beam {
    jl: f64,
    jeq: f64,
    beq: f64,
    ks: f64,
    kg: f64,
    kt: f64,
    km: f64,
    rm: f64,
    eta: f64,
}

impl Beam {
    /// From a column of Table 2.2 or 3.3: as printed ("thesis") or as the results need them ("truth").
    pub(crate) fn read(fixture: &Fixture, column: &str) -> Result<Self> {
        let get = |row: &str| fixture.number(row, column);
        Ok(Self {
            jl: get("Jl")?,
            jeq: get("Jeq")?,
            beq: get("Beq")?,
            ks: get("ks")?,
            kg: get("kg")?,
            kt: get("kt")?,
            km: get("km")?,
            rm: get("Rm")?,
            eta: get("eta_g")? * get("eta_m")?,
        })
    }

    /// The consistent set (E8, E9).
    fn consistent() -> Self {
        let (jl, jeq, beq, ks) = (0.0038, 2.084e-3, 0.025, 1.3);
        Self { jl, jeq, beq, ks, kg: 70.0, kt: 7.68e-3, km: 7.68e-3, rm: 2.6, eta: 0.9 * 0.69 }
    }

    /// Volts per newton metre: Rm/(ηg kg ηm kt).
    pub(crate) fn volts_per_torque(&self) -> f64 {
        self.rm / (self.eta * self.kg * self.kt)
    }

    /// C Jeq, the coefficient of θ'' (and, negative, of α'').
    fn inertia(&self) -> f64 {
        self.volts_per_torque() * self.jeq
    }

    /// C (Beq + ηg kg² km ηm kt / Rm), the coefficient of θ'.
    fn damping(&self) -> f64 {
        self.volts_per_torque() * (self.beq + self.eta * self.kg * self.kg * self.km * self.kt / self.rm)
    }

    /// −C ks, the coefficient of α in the θ-equation.
    fn stiffness(&self) -> f64 {
        -self.volts_per_torque() * self.ks
    }

    /// (Jl + Jeq)/Jl, by which the α-equation's coefficient of α is larger.
    pub(crate) fn inertia_ratio(&self) -> f64 {
        (self.jl + self.jeq) / self.jl
    }

    /// θ'' of equation 3.21 with B_l = 0: the torque in N m beside damping, back-emf and spring, over Jeq.
    pub(crate) fn hub_acceleration(&self, torque: f64, dtheta: f64, alpha: f64) -> f64 {
        let back_emf = self.kg * self.km / self.volts_per_torque() * dtheta;
        (torque - back_emf - self.beq * dtheta + self.ks * alpha) / self.jeq
    }

    /// ks/Jl, 1/s².
    pub(crate) fn spring_over_link(&self) -> f64 {
        self.ks / self.jl
    }

    /// The joint of section 3.4 as Table 3.5 has it (E8, E9): Jeq = 0.00208, Beq = 0.015.
    pub(crate) fn joint() -> Self {
        Self { jeq: 0.00208, beq: 0.015, ..Self::consistent() }
    }

    /// The spring's factor in the α-equation, ks (Jl + Jeq)/Jl.
    pub(crate) fn joint_stiffness(&self) -> f64 {
        self.ks * self.inertia_ratio()
    }
}

/// Something that follows from the constants.
type Quantity = fn(&Beam) -> f64;

/// What the constants, as printed and consistent, make of the thesis's other numbers: the table, and the
/// largest relative gap of the consistent set.
fn consistency(printed: &Beam, consistent: &Beam) -> (Table, f64) {
    let quantities: [(&str, Quantity, f64); 4] = [
        ("θ'' of Table 2.3: C·Jeq", Beam::inertia, 0.016231),
        ("θ' of Table 2.3: C·(Beq + ηg·kg²·km·ηm·kt/Rm)", Beam::damping, 0.7323),
        ("α in the θ-equation of Table 2.3: −C·ks", Beam::stiffness, -10.124),
        ("ratio of both α coefficients: (Jl + Jeq)/Jl", Beam::inertia_ratio, 15.672 / 10.124),
    ];
    let mut worst: f64 = 0.0;
    let mut rows = Vec::new();
    for (name, value, thesis) in quantities {
        worst = worst.max((value(consistent) / thesis - 1.0).abs());
        rows.push(vec![name.into(), number(thesis), number(value(printed)), number(value(consistent))]);
    }
    // E8: were Jl and Jeq merely swapped?
    let swapped = Beam { jl: printed.jeq, jeq: printed.jl, ..*printed };
    for (name, value) in [
        ("with Jl and Jeq swapped: C·Jeq", swapped.inertia()),
        ("with Jl and Jeq swapped: −C·ks·(Jl + Jeq)/Jl", swapped.stiffness() * swapped.inertia_ratio()),
    ] {
        rows.push(vec![
            name.into(),
            if name.ends_with("Jeq") { "0.016231" } else { "−15.672" }.into(),
            number(value),
            String::new(),
        ]);
    }
    let headings = ["", "thesis", "from the constants as printed", "from the consistent set"];
    let caption =
        "What the constants give, beside the thesis's own results; C = Rm/(ηg·kg·ηm·kt) V/(N m)".into();
    (Table { caption, headings: headings.map(String::from).into(), rows }, worst)
}

/// Table 2.2: constants, and what contradicts them (E7, E8, E9).
fn table_2_2(fixture: &Fixture) -> Result<Piece> {
    let (printed, consistent) = (Beam::read(fixture, "thesis")?, Beam::read(fixture, "truth")?);
    let mut piece = Piece::new(
        Status::Constants,
        "Data-sheet values. Two of them contradict the thesis's own Table 2.3; the last column is the set that agrees.",
    );
    let (table, worst) = consistency(&printed, &consistent);
    piece.tables.push(table);
    piece.checks.push(Check::new("C in V/(N m)", printed.volts_per_torque()));
    piece.checks.push(Check::new("largest gap of the consistent set to Table 2.3", worst));
    piece.checks.push(Check::new("C*Jeq as printed, against 0.016231", printed.inertia() / 0.016231));
    piece.checks.push(Check::new("C*Jeq with Jl and Jeq swapped", printed.volts_per_torque() * printed.jl));
    Ok(piece)
}

/// Table 2.3: the column 'Quanser' follows from the constants; the identified one needs a rig.
fn table_2_3(fixture: &Fixture) -> Result<Piece> {
    let beam = Beam::consistent();
    let values = vec![
        ("2.24: theta''".to_owned(), beam.inertia()),
        ("2.24: theta'".to_owned(), beam.damping()),
        ("2.24: alpha".to_owned(), beam.stiffness()),
        ("2.25: alpha''".to_owned(), -beam.inertia()),
        ("2.25: theta'".to_owned(), beam.damping()),
        ("2.25: alpha".to_owned(), beam.stiffness() * beam.inertia_ratio()),
    ];
    let mut worst: f64 = 0.0;
    for (row, value) in &values {
        worst = worst.max((value / fixture.number(row, "nominal")? - 1.0).abs());
    }
    let mut piece = Piece::new(
        Status::Constants,
        "The column Quanser follows from equation 2.21 and the consistent constants of Table 2.2. The identified \
         column comes from recordings that are not public; it can only be shown on a virtual rig, and is not made here.",
    );
    piece.columns.push(Column { title: "Quanser, computed".into(), values });
    piece.checks.push(Check::new("largest gap to the column Quanser", worst));
    Ok(piece)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn folds_cover_all_rows_once_whatever_their_number() {
        for (n, folds) in [(10, 5), (11, 5), (7, 10), (29_999, 5)] {
            let mut next = 0;
            for k in 0..folds {
                let range = fold(n, folds, k);
                assert_eq!(range.start, next);
                next = range.end;
            }
            assert_eq!(next, n);
        }
    }

    #[test]
    fn the_constants_in_use_are_those_of_the_tables() {
        let folder = crate::root().join("fixtures").join("thesis");
        let table = |id: &str| Fixture::read(&folder, id).unwrap();
        assert_eq!(Beam::read(&table("Table 2.2"), "truth").unwrap(), Beam::consistent());
        let joint = Beam { jeq: 0.002084, ..Beam::joint() };
        assert_eq!(Beam::read(&table("Table 3.3"), "truth").unwrap(), joint);
    }

    #[test]
    fn the_common_factor_is_that_of_erratum_e7() {
        assert!((Beam::consistent().volts_per_torque() - 7.78794).abs() < 5e-6);
    }
}
