//! The time of Algorithm 1 at full size: `cargo run --release -p greybox-sparse --example time`.
#![allow(clippy::disallowed_methods, clippy::single_range_in_vec_init, clippy::print_stdout)]

use std::time::Instant;

use greybox_sparse::folds::train_test;
use greybox_sparse::select::{logspace, search};
use greybox_sparse::{Library, Options, Problem, Rows, Selector};

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let n = 40_000;
    let x: Vec<f64> =
        (0..n).map(|i| 1.3 * (0.0051 * i as f64).sin() + 0.4 * (0.0031 * i as f64).cos()).collect();
    let v: Vec<f64> = (0..n).map(|i| (0.0043 * i as f64).cos() - 0.7 * (0.0017 * i as f64).sin()).collect();
    let y: Vec<f64> = (0..n)
        .map(|i| x[i] + 0.5 * v[i] + 0.8 * x[i].powi(3) + 0.01 * (12.9898 * (i * i) as f64).sin())
        .collect();
    let library = Library::tensor(&["x", "x'"], &[6, 6]);
    let columns = library.evaluate(&[&x, &v], &[])?;
    for selector in [Selector::StlsqRaw, Selector::StlsqNormalised, Selector::LassoRefit, Selector::Backward]
    {
        let rows = Rows::from_vecs(&columns, &y)?;
        let split = train_test(&[0..n], 0.5, 100)?;
        let problem = Problem::new(rows, library.lengths(), &[], split)?;
        let mut options = Options::raw();
        options.selector = selector;
        options.grid = logspace(1e-4, 1.0, 50);
        let mut best = f64::INFINITY;
        for _ in 0..5 {
            let start = Instant::now();
            search(&problem, &options)?;
            best = best.min(start.elapsed().as_secs_f64());
        }
        println!("{selector:?}: {:.1} ms", 1e3 * best);
    }
    Ok(())
}
