//! Which terms has the equation of motion of this oscillator? `cargo run --release --package example-terms`.
#![allow(clippy::print_stdout)]

use greybox_sparse::{
    BootstrapOptions, Criterion, Library, Options, Problem, Resample, Rows, SampleSize, SparseError, Split,
    search, stability,
};

/// Sample time, s.
const STEP: f64 = 0.005;

/// Samples of displacement (in a unit of `1/per_metre` m), velocity, force and a noisy acceleration of
/// 2 x″ + 0.6 x′ + 150 x + 900 x³ = f, in SI.
fn samples(rows: usize, per_metre: f64) -> [Vec<f64>; 4] {
    let force = |t: f64| 20.0 * (5.0 * t).sin() + 15.0 * (8.3 * t).cos() + 10.0 * (2.1 * t).sin();
    let acceleration = |f: f64, x: f64, v: f64| (f - 0.6 * v - 150.0 * x - 900.0 * x.powi(3)) / 2.0;
    let (mut x, mut v, mut state) = (0.1, 0.0, 7_u32);
    let mut noise = move || {
        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        f64::from(state) / f64::from(u32::MAX) - 0.5
    };
    let mut out: [Vec<f64>; 4] = Default::default();
    for row in 0..rows {
        let t = STEP * row as f64;
        let measured = acceleration(force(t), x, v) + 1.5 * noise();
        for (column, value) in
            out.iter_mut().zip([per_metre * x, per_metre * v, force(t), per_metre * measured])
        {
            column.push(value);
        }
        for step in 0..10 {
            v += 0.1 * STEP * acceleration(force(t + 0.1 * STEP * f64::from(step)), x, v);
            x += 0.1 * STEP * v;
        }
    }
    out
}

/// A term of the model found.
struct Term {
    label: String,
    coefficient: f64,
    /// Standard deviation over the bootstrap's replicates.
    deviation: f64,
    /// Share of the replicates that chose it.
    inclusion: f64,
}

/// x″ as a sum of monomials in x, v and f: first half of the rows to fit, 5 to 10 folds for λ, the second half for the
/// order, by BIC with the number of independent rows that the residuals show.
fn terms([x, v, f, acceleration]: &[Vec<f64>; 4]) -> Result<Vec<Term>, SparseError> {
    let library = Library::total_degree(&["x", "v", "f"], 4, true);
    let columns = library.evaluate(&[x, v, f], &[])?;
    let rows = Rows::from_vecs(&columns, acceleration)?;
    let split = Split::of_rows(rows.rows(), 0.5, 50)?;
    let problem = Problem::new(rows, library.lengths(), &[], split)?;
    let options =
        Options { criterion: Criterion::Bic, sample_size: SampleSize::Effective, ..Options::default() };
    let found = search(&problem, &options)?;

    let resample = Resample::Blocks { length: 100, circular: true };
    let replicates = BootstrapOptions { resample, ..BootstrapOptions::default() };
    let spread = stability(&problem, &options, &found, &replicates)?;
    let model = found.model();
    let named = library.named(&model.coefficients).into_iter().zip(&model.support);
    Ok(named
        .map(|((label, coefficient), &j)| Term {
            label,
            coefficient,
            deviation: spread.deviation[j],
            inclusion: spread.inclusion[j],
        })
        .collect())
}

fn main() -> Result<(), SparseError> {
    for term in terms(&samples(6000, 1.0))? {
        println!(
            "{:10.4} ± {:.4}  {:4} in {:3.0} % of the replicates",
            term.coefficient,
            term.deviation,
            term.label,
            100.0 * term.inclusion
        );
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn assert_found(per_metre: f64) {
        let found = terms(&samples(6000, per_metre)).unwrap();
        let labels: Vec<&str> = found.iter().map(|t| t.label.as_str()).collect();
        assert_eq!(labels, ["x", "v", "f", "x^3"], "{per_metre} per metre");
        let truth = [-75.0, -0.3, 0.5 * per_metre, -450.0 / per_metre.powi(2)];
        for (term, truth) in found.iter().zip(truth) {
            assert!((term.coefficient / truth - 1.0).abs() < 0.05, "{}: {}", term.label, term.coefficient);
            assert!((term.coefficient - truth).abs() < 4.0 * term.deviation, "{}", term.label);
            assert!(term.inclusion > 0.9, "{}: {}", term.label, term.inclusion);
        }
    }

    #[test]
    fn the_duffing_oscillator_is_found_in_metres_and_in_millimetres() {
        assert_found(1.0);
        assert_found(1e3);
    }
}
