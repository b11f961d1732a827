//! Rows of windows over a record of 4 000 samples.
#![allow(missing_docs)]

use criterion::{Criterion, criterion_group, criterion_main};
use greybox_algebraic::{Column, Hold, Kernel, rows};

fn all(c: &mut Criterion) {
    let kernel = match Kernel::new(2, 2, 500, 1e-3) {
        Ok(kernel) => kernel,
        Err(e) => panic!("{e}"),
    };
    let signal: Vec<f64> = (0..4000).map(|k| (0.01 * f64::from(k)).sin()).collect();
    let columns = [2, 1, 0].map(|order| Column { signal: &signal, order, hold: Hold::Smooth });
    c.bench_function("windows of 500 samples", |b| b.iter(|| rows(&kernel, &columns, 20)));
}

criterion_group!(group, all);
criterion_main!(group);
