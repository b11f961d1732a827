//! One step of the sliding-mode law of the flexible link.
#![allow(missing_docs)]

use criterion::{Criterion, criterion_group, criterion_main};
use greybox_smc::thesis::LinkTangent;
use greybox_smc::{BoundaryLayer, FlatOutput, Law, Rate, SmcError, Surface, Target};

fn benches(c: &mut Criterion) -> Result<(), SmcError> {
    let link = LinkTangent::IDENTIFIED.tangent();
    let (surface, layer) = (Surface::repeated(16.0)?, BoundaryLayer::new(590.0, 5.9)?);
    let law = Law::new(FlatOutput::new(&link)?, surface, layer, 10.0, Rate::Model)?;
    let target = Target::rest([0.1; 4]);
    c.bench_function("law of 4 states", |b| b.iter(|| law.step(&[0.01; 4], &[0.3; 4], &link.b, &target)));
    Ok(())
}

fn all(c: &mut Criterion) {
    if let Err(e) = benches(c) {
        panic!("{e}");
    }
}

criterion_group!(group, all);
criterion_main!(group);
