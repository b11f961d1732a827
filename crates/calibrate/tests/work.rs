//! What a fit may cost.

use std::sync::Arc;

use crate::common::*;
use greybox_calibrate::{Ending, Fit, Limits, Point, Segmentation, Setup, Work};
use greybox_model::Model;
use rayon::prelude::*;

/// An oscillator whose parameters are free, and four segments of its recording.
fn oscillator() -> (Setup, Segmentation) {
    let (n, dt) = (600, 0.01);
    let f = force(7, n, dt, 1.0, 5.0);
    let model = Model::from_toml(OSCILLATOR, "oscillator.toml").unwrap();
    let measured = measure(&model, &f, dt, &[0.0, 0.0]);
    let free = setup(&model, &f, dt, &measured);
    let level = free.level(4);
    (free, level)
}

/// A fit with little work ends early with the step that it is at, and with the same one whatever other fits do.
#[test]
fn a_fit_ends_at_its_own_limit() {
    let (free, level) = oscillator();
    let fit = |most: Option<u64>| -> (Fit, u64) {
        let work = Arc::new(most.map_or_else(Work::default, Work::of_fits_within));
        let setup = Setup { work: work.clone(), ..free.clone() };
        let parameters: Vec<f64> = setup.values().iter().map(|v| 3.0 * v).collect();
        let point = Point { starts: setup.starts(&level, &parameters), parameters };
        let limits = Limits { iterations: 50, tolerance: 1e-12 };
        let fits: Vec<Fit> = (0..4)
            .into_par_iter()
            .map(|_| setup.fit(&level, &free.data.sigma, std::slice::from_ref(&point), limits))
            .collect();
        for other in &fits {
            assert_eq!(other.point, fits[0].point);
        }
        (fits[0].clone(), work.done() / 4)
    };
    let (whole, cost) = fit(None);
    assert_eq!(whole.ending, Ending::Converged);
    let (half, spent) = fit(Some(cost / 2));
    assert_eq!(half.ending, Ending::Limit);
    assert!(half.iterations < whole.iterations && half.iterations > 1, "{}", half.iterations);
    assert!((cost / 2..cost).contains(&spent), "{spent} of {cost}");
    let (same, _) = fit(Some(2 * cost));
    assert_eq!(same.point, whole.point);
}

/// What a part does counts for the whole; it ends at its own limit, at that of the whole, and when the whole is given up.
#[test]
fn a_part_of_the_work_ends_alone_and_with_the_whole() {
    let (free, level) = oscillator();
    let ending = |work: Work| -> (Ending, u64) {
        let work = Arc::new(work);
        let setup = Setup { work: work.clone(), ..free.clone() };
        let parameters: Vec<f64> = setup.values().iter().map(|v| 3.0 * v).collect();
        let point = Point { starts: setup.starts(&level, &parameters), parameters };
        let limits = Limits { iterations: 50, tolerance: 1e-12 };
        (setup.fit(&level, &free.data.sigma, &[point], limits).ending, work.done())
    };
    let (_, cost) = ending(Work::default());
    let ample = Arc::new(Work::within(10 * cost));
    assert_eq!(ending(Work::part_of(&ample, 2 * cost)), (Ending::Converged, cost));
    assert_eq!(ample.done(), cost);
    let (cut, spent) = ending(Work::part_of(&ample, cost / 2));
    assert_eq!((cut, ample.done()), (Ending::Limit, cost + spent));
    assert!(spent < cost && !ample.is_spent(), "{spent} of {cost}");
    let little = Arc::new(Work::within(cost / 2));
    assert_eq!(ending(Work::part_of(&little, 2 * cost)).0, Ending::Limit);
    let over = Arc::new(Work::default());
    over.give_up();
    assert!(ending(Work::part_of(&over, 2 * cost)).1 < cost / 2);
}

/// A point that is alone is simulated once, with its derivatives; one beside another is evaluated first. The fit is the same.
#[test]
fn a_fit_does_not_depend_on_how_its_start_was_simulated() {
    let (free, level) = oscillator();
    for factor in [0.4, 1.2, 3.0] {
        let parameters: Vec<f64> = free.values().iter().map(|v| factor * v).collect();
        let point = Point { starts: free.starts(&level, &parameters), parameters };
        for iterations in [0, 1, 2, 50] {
            let limits = Limits { iterations, tolerance: 1e-12 };
            let work = |points: &[Point]| {
                let work = Arc::new(Work::default());
                let setup = Setup { work: work.clone(), ..free.clone() };
                (setup.fit(&level, &free.data.sigma, points, limits), work.done())
            };
            let (alone, cost) = work(std::slice::from_ref(&point));
            let (beside, dearer) = work(&[point.clone(), point.clone()]);
            assert_eq!(
                (&alone.point, alone.cost, alone.iterations),
                (&beside.point, beside.cost, beside.iterations)
            );
            assert_eq!((&alone.rss, alone.ending), (&beside.rss, beside.ending));
            assert!(cost < dearer, "{cost} {dearer}");
        }
    }
}

/// At the minimum, the first step promises nothing and gains nothing: there is nothing that a second could add.
#[test]
fn a_fit_that_begins_at_its_end_takes_one_step() {
    let (free, level) = oscillator();
    let fit = |parameters: Vec<f64>, starts: Vec<Vec<f64>>, tolerance: f64| {
        let limits = Limits { iterations: 50, tolerance };
        free.fit(&level, &free.data.sigma, &[Point { parameters, starts }], limits)
    };
    let far: Vec<f64> = free.values().iter().map(|v| 3.0 * v).collect();
    let starts = free.starts(&level, &far);
    let first = fit(far, starts, 1e-9);
    assert!(first.ending == Ending::Converged && first.iterations > 3, "{first:?}");
    let Point { parameters, starts } = first.point;
    let again = fit(parameters, starts, 1e-4);
    assert_eq!((again.ending, again.iterations), (Ending::Converged, 1));
    assert!((again.cost / first.cost - 1.0).abs() < 1e-4);
}
