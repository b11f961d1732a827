//! Gram matrix, paths and Algorithm 1 on 4 000 rows of the oscillator of thesis equation 2.18.
#![allow(missing_docs)]

use std::ops::Range;

use criterion::{Criterion, criterion_group, criterion_main};
use greybox_sparse::folds::train_test;
use greybox_sparse::lasso::{LassoOptions, lasso_path};
use greybox_sparse::select::{Selector, logspace, search};
use greybox_sparse::stlsq::{Threshold, stlsq_path};
use greybox_sparse::{Gram, Library, Options, Problem, Rows, SparseError, Triangle};

const ROWS: usize = 4000;

struct Record {
    x: Vec<f64>,
    v: Vec<f64>,
    y: Vec<f64>,
}

fn record() -> Record {
    let at = |f: &dyn Fn(f64) -> f64| (0..ROWS).map(|i| f(i as f64)).collect::<Vec<f64>>();
    let x = at(&|i| 1.3 * (0.051 * i).sin() + 0.4 * (0.031 * i).cos());
    let v = at(&|i| (0.043 * i).cos() - 0.7 * (0.017 * i).sin());
    let noise = at(&|i| 0.01 * (12.9898 * i * i).sin());
    let y = (0..ROWS).map(|i| x[i] + 0.5 * v[i] + 0.8 * x[i].powi(3) + noise[i]).collect();
    Record { x, v, y }
}

fn benches(c: &mut Criterion) -> Result<(), SparseError> {
    let Record { x, v, y } = record();
    let all: Vec<Range<usize>> = std::iter::once(0..ROWS).collect();
    let library = Library::tensor(&["x", "x'"], &[6, 6]);
    c.bench_function("gram of 48 terms", |b| {
        b.iter(|| Gram::of_library(&library, &[&x, &v], &[], &y, &all));
    });
    let columns = library.evaluate(&[&x, &v], &[])?;
    let rows = Rows::from_vecs(&columns, &y)?;
    c.bench_function("triangle of 48 columns", |b| b.iter(|| Triangle::of_rows(&rows, &all)));
    let triangle = Triangle::of_rows(&rows, &all)?.first_columns(15);
    let (weights, grid) = (vec![1.0; 15], logspace(1e-3, 1.0, 50));
    c.bench_function("LASSO path", |b| {
        b.iter(|| lasso_path(&triangle, &weights, &grid, &LassoOptions::default()));
    });
    c.bench_function("STLSQ path", |b| b.iter(|| stlsq_path(&triangle, &[], &grid, Threshold::Raw)));
    let problem = Problem::new(rows, library.lengths(), &[], train_test(&all, 0.5, 100)?)?;
    let mut options = Options::raw();
    (options.selector, options.grid) = (Selector::Lasso, grid);
    c.bench_function("Algorithm 1", |b| b.iter(|| search(&problem, &options)));
    Ok(())
}

fn all(c: &mut Criterion) {
    if let Err(e) = benches(c) {
        panic!("{e}");
    }
}

criterion_group!(group, all);
criterion_main!(group);
