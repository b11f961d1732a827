//! How long a regulator of the F16 (thesis Eq 4.40) and an iteration of Algorithm 3 take.
#![allow(clippy::print_stdout)]

use std::hint::black_box;
use std::time::Instant;

use greybox_hjb::{
    AdamaxOptions, Domain, HjbError, Linear, Monomials, PolicyOptions, Problem, adamax, lqr, policy_iteration,
};
use nalgebra::{DMatrix, dmatrix};

/// Median time of `run` over `times`, in microseconds.
fn median(times: usize, mut run: impl FnMut()) -> f64 {
    let mut taken: Vec<f64> = (0..times)
        .map(|_| {
            let start = Instant::now();
            run();
            start.elapsed().as_secs_f64() * 1e6
        })
        .collect();
    taken.sort_by(f64::total_cmp);
    taken[times / 2]
}

fn main() -> Result<(), HjbError> {
    let plant = Linear {
        a: dmatrix![-1.01887, 0.90506, -0.00215; 0.82225, -1.07741, -0.17555; 0.0, 0.0, -1.0],
        b: dmatrix![0.0; 0.0; 1.0],
    };
    let (q, r) = (DMatrix::identity(3, 3), dmatrix![1.0]);
    let regulator = median(2001, || {
        black_box(lqr(black_box(&plant.a), &plant.b, &q, &r).is_ok());
    });
    println!("lqr, 3 states: {regulator:.1} us");
    let points = Domain::symmetric(&[5.0, 10.0, 10.0])?.grid(&[10, 10, 5])?;
    let problem = Problem::new(&plant, &q, &r, Monomials::even(3, 2)?, &points)?;
    let options = AdamaxOptions { iterations: 6000, patience: None, ..AdamaxOptions::default() };
    let training = median(21, || {
        black_box(adamax(black_box(&problem), &[1.0; 6], &options).is_ok());
    });
    println!("Algorithm 3, 500 points, 6 weights: {:.3} us per iteration", training / 6000.0);
    let fast = median(201, || {
        black_box(policy_iteration(black_box(&problem), &[0.0; 6], PolicyOptions::default()).is_ok());
    });
    println!("policy iteration on the same points: {fast:.1} us in all");
    Ok(())
}
