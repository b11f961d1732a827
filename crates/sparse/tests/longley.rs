//! Longley's data: the classic ill-conditioned regression, with the certified values of the NIST Statistical
//! Reference Datasets (StRD, "Longley").
#![allow(clippy::single_range_in_vec_init)]

use greybox_sparse::covariance::{Covariance, covariance};
use greybox_sparse::{Rows, Triangle};

const EMPLOYED: [f64; 16] = [
    60323., 61122., 60171., 61187., 63221., 63639., 64989., 63761., 66019., 67857., 68169., 66513., 68655.,
    69564., 69331., 70551.,
];

fn columns() -> Vec<Vec<f64>> {
    vec![
        vec![1.0; 16],
        vec![
            83.0, 88.5, 88.2, 89.5, 96.2, 98.1, 99.0, 100.0, 101.2, 104.6, 108.4, 110.8, 112.6, 114.2, 115.7,
            116.9,
        ],
        vec![
            234289., 259426., 258054., 284599., 328975., 346999., 365385., 363112., 397469., 419180.,
            442769., 444546., 482704., 502601., 518173., 554894.,
        ],
        vec![
            2356., 2325., 3682., 3351., 2099., 1932., 1870., 3578., 2904., 2822., 2936., 4681., 3813., 3931.,
            4806., 4007.,
        ],
        vec![
            1590., 1456., 1616., 1650., 3099., 3594., 3547., 3350., 3048., 2857., 2798., 2637., 2552., 2514.,
            2572., 2827.,
        ],
        vec![
            107608., 108632., 109773., 110929., 112075., 113270., 115094., 116219., 117388., 118734.,
            120445., 121950., 123366., 125368., 127852., 130081.,
        ],
        (1947..1963).map(f64::from).collect(),
    ]
}

const CERTIFIED: [f64; 7] = [
    -3482258.63459582,
    15.0618722713733,
    -0.358191792925910e-1,
    -2.02022980381683,
    -1.03322686717359,
    -0.511041056535807e-1,
    1829.15146461355,
];

#[test]
fn coefficients_and_errors_are_the_certified_ones() {
    let columns = columns();
    let rows = Rows::from_vecs(&columns, &EMPLOYED).unwrap();
    let fit = Triangle::of_rows(&rows, &[0..16]).unwrap().solve().unwrap();
    for (c, truth) in fit.coefficients.iter().zip(CERTIFIED) {
        assert!((c / truth - 1.0).abs() < 1e-9, "{c} is not {truth}");
    }
    let sigma = (fit.rss / 9.0).sqrt();
    assert!((sigma / 304.854073561965 - 1.0).abs() < 1e-9, "{sigma}");
    let active: Vec<usize> = (0..7).collect();
    let (_, v) = covariance(&rows, &[0..16], &active, Covariance::Independent).unwrap();
    assert!((v[0].sqrt() / 890420.383607373 - 1.0).abs() < 1e-8);
    assert!((v[8].sqrt() / 84.9149257747669 - 1.0).abs() < 1e-8);
}
