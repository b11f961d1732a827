//! One sample of the thesis's observer.
#![allow(missing_docs)]

use criterion::{Criterion, criterion_group, criterion_main};
use greybox_eso::{Design, Observer, Scheme};

fn all(c: &mut Criterion) {
    let mut observer = match Observer::new(Design::thesis(), 1e-3, Scheme::Euler) {
        Ok(observer) => observer,
        Err(e) => panic!("{e}"),
    };
    c.bench_function("observer of 2 states", |b| b.iter(|| observer.update(0.3, 0.0)));
}

criterion_group!(group, all);
criterion_main!(group);
