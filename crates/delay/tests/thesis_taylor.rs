//! Algorithm 2 on the delayed Duffing oscillator of thesis §3.3.

use crate::common::{DT, Duffing, median};
use greybox_algebraic::{Column, Hold, Initial, Iterated, Kernel, Restart};
use greybox_delay::expansion::{Expansion, Reading};
use greybox_delay::taylor::{Data, Model, Options, Order, Search, search};

/// Exponents (i, j) of xⁱ x′ʲ without the constant, nested: order N adds those with max(i, j) = N.
fn powers(order: usize) -> Vec<(i32, i32)> {
    let order = order as i32;
    (1..=order)
        .flat_map(|n| {
            let upper = (0..n).map(move |i| (i, n));
            let right = (0..=n).map(move |j| (n, j));
            upper.chain(right)
        })
        .collect()
}

fn orders(last: usize) -> Vec<Order> {
    (1..=last).map(|n| Order { order: n, columns: 2 + powers(n).len() }).collect()
}

/// Columns and target.
type Rows = (Vec<Vec<f64>>, Vec<f64>);

/// x‴, x″ and the library with the true velocity, then the force, through an operation.
fn through(r: &Duffing, order: usize, operation: impl Fn(&[Column<'_>]) -> Vec<Vec<f64>>) -> Rows {
    let products: Vec<Vec<f64>> = powers(order)
        .iter()
        .map(|&(i, j)| r.x.iter().zip(&r.v).map(|(x, v)| x.powi(i) * v.powi(j)).collect())
        .collect();
    let smooth = |signal, order| Column { signal, order, hold: Hold::Smooth };
    let mut columns = vec![smooth(&r.x, 3), smooth(&r.x, 2)];
    // The velocity term needs no velocity.
    columns.extend(powers(order).iter().zip(&products).map(|(power, product)| match power {
        (0, 1) => smooth(&r.x, 1),
        _ => smooth(product, 0),
    }));
    columns.push(smooth(&r.f, 0));
    let mut rows = operation(&columns);
    let target = rows.pop().expect("valid input");
    (rows, target)
}

/// Windows of 1 s with the kernel t²(T − t)², which leaves the first sample to the third derivative.
fn windows(r: &Duffing, order: usize, initial: Initial) -> Rows {
    let kernel = Kernel::new(2, 3, 1000, DT).expect("valid input").with_initial(initial);
    through(r, order, |columns| greybox_algebraic::rows(&kernel, columns, 10).expect("valid input").columns)
}

/// Eq 3.10 at every tenth sample of one window over the whole recording.
fn literal(r: &Duffing, order: usize, initial: Initial) -> Rows {
    let form = Iterated::new(2, 3, DT).expect("valid input").with_initial(initial);
    let restart = Restart { intervals: r.x.len() - 1, hop: 1, every: 10 };
    through(r, order, |columns| form.rows(columns, restart).expect("valid input").columns)
}

fn data(rows: &Rows) -> Data<'_> {
    Data { columns: &rows.0, target: &rows.1 }
}

fn algorithm_2(train: &Rows, test: &Rows, last: usize, options: &Options) -> Search {
    search(data(train), data(test), &orders(last), options).expect("valid input")
}

fn reading(model: &Model) -> Reading {
    Expansion::new(-2.0, 3).expect("valid input").read(3, model.coefficients[0], 0.0).expect("valid input")
}

/// x‴, x″, x′, x, x³, x′³, x²x′ among the columns.
fn is_exact(model: &Model) -> bool {
    let powers = powers(6);
    let mut active: Vec<(i32, i32)> =
        model.active().iter().filter(|j| **j >= 2).map(|j| powers[j - 2]).collect();
    active.sort_unstable();
    active == [(0, 1), (0, 3), (1, 0), (2, 1), (3, 0)]
}

#[test]
fn windows_find_the_structure_and_the_delay_up_to_truncation() {
    let tau: Vec<f64> = (0..6)
        .map(|seed| {
            // The first is without noise.
            let noise = if seed == 0 { 0.0 } else { 0.01 };
            let rows = |r: &Duffing| windows(r, 4, Initial::FirstSample);
            let train = rows(&Duffing::training(10.0, noise, seed));
            let test = rows(&Duffing::test(10.0, noise, seed));
            let search = algorithm_2(&train, &test, 4, &Options::thesis(2, seed));
            let model = search.model().unwrap();
            assert!(model.order == 3 && is_exact(model), "seed {seed}: {model:?}");
            let reading = reading(model);
            assert!(reading.admissible && (0.16..=0.20).contains(&reading.delay), "seed {seed}: {reading:?}");
            reading.delay
        })
        .collect();
    println!("{tau:?}");
    assert!((tau[0] - 0.1816).abs() < 0.001, "{tau:?}");
    assert!((0.165..=0.190).contains(&median(tau.clone())), "{tau:?}");
}

#[test]
fn printed_signals_give_the_delay_of_the_thesis() {
    let rows = |noise: f64, seed: u64, initial: Initial| {
        let rows = |r: &Duffing| literal(r, 4, initial);
        (rows(&Duffing::training(5.0, noise, seed)), rows(&Duffing::test(5.0, noise, seed)))
    };
    // Without noise the truncation alone leaves 0.149, with E13 corrected 0.155.
    for (initial, expected) in [(Initial::Separate, 0.149), (Initial::FirstSample, 0.155)] {
        let (train, test) = rows(0.0, 0, initial);
        let search = algorithm_2(&train, &test, 4, &Options::thesis(2, 0));
        let model = search.model().unwrap();
        assert!(model.order == 3 && is_exact(model), "{model:?}");
        assert!((reading(model).delay - expected).abs() < 0.002, "{:?}", reading(model));
        // Fig 3.1: a large drop at order 3, no gain at 4.
        let errors: Vec<f64> = search.models.iter().map(|m| m.test_error).collect();
        assert!(errors[1] > 1e4 * errors[2] && errors[3] > 0.9 * errors[2], "{errors:?}");
    }
    // With noise: the structure at order 3 always, and the delay of the truncation in the median. A single recording
    // may land anywhere from 0.1 to 0.3, by the luck of the draw alone: recording 3 does so over seeds of the draw.
    let tau: Vec<f64> = (1..12)
        .map(|seed| {
            let (train, test) = rows(0.01, seed, Initial::Separate);
            let search = algorithm_2(&train, &test, 3, &Options::thesis(2, seed));
            let model = &search.models[2];
            assert!(is_exact(model), "seed {seed}: {model:?}");
            let reading = reading(model);
            assert!((0.05..0.4).contains(&reading.delay), "seed {seed}: {reading:?}");
            reading.delay
        })
        .collect();
    println!("{tau:?}");
    assert!((0.14..=0.17).contains(&median(tau.clone())), "{tau:?}");
}

#[test]
fn initial_conditions_left_in_restarted_windows_ruin_the_delay() {
    // Erratum E13: over one growing window x₀ t² is a nuisance, over many short ones it is fatal.
    let (train, test) = (Duffing::training(10.0, 0.0, 0), Duffing::test(10.0, 0.0, 0));
    let rows = |r: &Duffing| windows(r, 3, Initial::Separate);
    let search = algorithm_2(&rows(&train), &rows(&test), 3, &Options::thesis(2, 0));
    let reading = reading(&search.models[2]);
    assert!(reading.delay < 0.1, "{reading:?}");
}
