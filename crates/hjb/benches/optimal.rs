//! The regulator of the F16 (thesis Eq 4.40) and iterations of Algorithm 3.
#![allow(missing_docs)]

use criterion::{Criterion, criterion_group, criterion_main};
use greybox_hjb::{AdamaxOptions, Domain, HjbError, Linear, Monomials, Problem, adamax, lqr};
use nalgebra::{DMatrix, dmatrix};

fn benches(c: &mut Criterion) -> Result<(), HjbError> {
    let plant = Linear {
        a: dmatrix![-1.01887, 0.90506, -0.00215; 0.82225, -1.07741, -0.17555; 0.0, 0.0, -1.0],
        b: dmatrix![0.0; 0.0; 1.0],
    };
    let (q, r) = (DMatrix::identity(3, 3), dmatrix![1.0]);
    c.bench_function("regulator of 3 states", |b| b.iter(|| lqr(&plant.a, &plant.b, &q, &r)));
    let points = Domain::symmetric(&[5.0, 10.0, 10.0])?.grid(&[10, 10, 5])?;
    let problem = Problem::new(&plant, &q, &r, Monomials::even(3, 2)?, &points)?;
    let options = AdamaxOptions { iterations: 1000, patience: None, ..AdamaxOptions::default() };
    c.bench_function("Algorithm 3, 1000 iterations", |b| {
        b.iter(|| adamax(&problem, &[1.0; 6], &options));
    });
    Ok(())
}

fn all(c: &mut Criterion) {
    if let Err(e) = benches(c) {
        panic!("{e}");
    }
}

criterion_group!(group, all);
criterion_main!(group);
