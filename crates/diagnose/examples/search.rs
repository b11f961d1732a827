//! Developer's view of a search: `search MODEL.toml TRAIN.csv … -- TEST.csv …`
#![allow(clippy::disallowed_methods, clippy::print_stdout)]

use std::sync::Arc;

use greybox_calibrate::{Data, Setup, free_parameters};
use greybox_diagnose::{ProgressListener, Stage, Weighed, evidence::Evidence, fitted, library, search};

struct Talk(std::time::Instant, Arc<greybox_calibrate::Work>);
impl ProgressListener for Talk {
    fn stage(&self, stage: Stage) {
        println!("{:7.2} {:7.2} G {stage:?}", self.0.elapsed().as_secs_f64(), self.1.done() as f64 / 1e9);
    }
    fn weighed(&self, w: &Weighed<'_>) {
        let seconds = self.0.elapsed().as_secs_f64();
        println!(
            "{seconds:7.2}   best {}: {:?} robust {:.1}",
            w.kinds.join(" and "),
            w.evidence,
            (w.robust)()
        );
    }
    fn tried(&self, kind: &str, expression: &str, e: &Evidence) {
        println!(
            "            {kind:26} {expression:40} score {:9.1} drop {:.4} cv {:.4} t {:.1} + {:.2} focus {:.2}",
            e.score,
            e.drop,
            e.cross_validation_gain,
            e.t,
            e.improved_fold_fraction,
            e.improvement_concentration
        );
    }
    fn screened(&self, ranking: &[(&str, f64)]) {
        let text: Vec<String> = ranking.iter().take(14).map(|(k, g)| format!("{k} {g:.3}")).collect();
        println!("            {}", text.join(", "));
    }
    fn dropped(&self, kind: &str) {
        println!("   dropped {kind}");
    }
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let text = std::fs::read_to_string(&args[0])?;
    let model = greybox_model::Model::from_toml(&text, &args[0])?;
    let split = args.iter().position(|a| a == "--").unwrap_or(args.len());
    let read = |names: &[String]| -> Result<Vec<_>, Box<dyn std::error::Error>> {
        Ok(names.iter().map(greybox_recording::read_csv).collect::<Result<Vec<_>, _>>()?)
    };
    let train = read(&args[1..split])?;
    let test = read(args.get(split + 1..).unwrap_or(&[]))?;
    let data = Arc::new(Data::new(&model, &train)?);
    let setup = Setup::new(&model, data, free_parameters(&model))?;
    let talk = Talk(std::time::Instant::now(), setup.work.clone());
    println!("sigma {:?} spread {:?} method {:?}", setup.data.sigma, setup.data.spread, setup.method);
    for (i, s) in setup.data.pieces[0].smooth.iter().enumerate() {
        println!("channel {i} window {} {}", s.window, s.derivative_window);
    }
    let library = library::built_in()?;
    let search = search::Search::new(setup, &library, &talk);
    println!("{} candidates", search.candidates().len());
    let found = search.run();
    for (name, f) in [("calibrated", &found.calibrated), ("improved", &found.improved)] {
        println!("--- {name} holds {:?} method {:?}", f.setup.holds, f.setup.method);
        for e in &f.setup.model.equations {
            println!("  {}: {} = {}", e.name, e.lhs, e.rhs);
        }
        for (p, v) in f.setup.model.parameters.iter().zip(&f.fit.point.parameters) {
            println!("  {} = {v:.6}", p.name);
        }
        println!("  level rms {:?}", fitted::rms(&f.fit, &found.scale));
        let run = f.setup.free_run(&f.fit.point.parameters, &found.scale);
        println!("  train {:?}", f.setup.scores(&run, &f.fit.point.parameters, 1.0, None));
        if !test.is_empty() {
            let data = Arc::new(Data::new(&model, &test)?);
            let mut held = Setup::new(&f.setup.model, data, vec![])?;
            held.method = f.setup.method;
            let run = held.free_run(&f.fit.point.parameters, &found.scale);
            println!("  test {:?}", held.scores(&run, &f.fit.point.parameters, 1.0, None));
        }
    }
    for a in &found.accepted {
        println!("{} {:?} {:?}", library[a.candidate.mechanism].kind, a.candidate.place, a.evidence);
        for r in &a.alternatives {
            println!(
                "    {} score {:.1} equivalent {}",
                library[r.candidate.mechanism].kind, r.evidence.score, r.equivalent
            );
        }
    }
    for f in [&found.calibrated, &found.improved] {
        let s = greybox_diagnose::discrepancy::test(f.at(&found.scale));
        println!("free shapes {:?}", s.map(|s| (s.gain, s.t)));
    }
    println!("{:7.2} done", talk.0.elapsed().as_secs_f64());
    Ok(())
}
