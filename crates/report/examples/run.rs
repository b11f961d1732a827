//! Developer's view: `run MODEL.toml TRAIN.csv … -- TEST.csv … --out DIR`
use greybox_diagnose::{Observer, Options, Stage, diagnose, evidence::Evidence};
use greybox_report::convert::{Sources, improved_toml, page, report};

struct Talk(std::time::Instant);
impl Observer for Talk {
    fn stage(&self, stage: Stage) {
        println!("{:7.2} {stage:?}", self.0.elapsed().as_secs_f64());
    }
    fn weighed(&self, kind: &str, e: &Evidence, share: f64) {
        println!("{:7.2}   best {kind}: {e:?} share {share:.2e}", self.0.elapsed().as_secs_f64());
    }
    fn dropped(&self, kind: &str) {
        println!("   dropped {kind}");
    }
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let text = std::fs::read_to_string(&args[0])?;
    let model = greybox_model::Model::from_toml(&text, &args[0])?;
    let out = args.iter().position(|a| a == "--out").ok_or("--out")?;
    let split = args.iter().position(|a| a == "--").unwrap_or(out);
    let read = |names: &[String]| -> Result<Vec<_>, Box<dyn std::error::Error>> {
        Ok(names.iter().map(greybox_recording::read_csv).collect::<Result<Vec<_>, _>>()?)
    };
    let train = read(&args[1..split])?;
    let holdout = if split < out { read(&args[split + 1..out])? } else { Vec::new() };
    let talk = Talk(std::time::Instant::now());
    let d = diagnose(&model, &train, &holdout, &Options::default(), &talk)?;
    println!("{:7.2} diagnosed", talk.0.elapsed().as_secs_f64());
    let sources = Sources { model_file: &args[0], model_text: &text, train: &train, holdout: &holdout };
    let r = report(&d, &sources);
    for s in &r.summary {
        println!("{s}");
    }
    std::fs::create_dir_all(&args[out + 1])?;
    std::fs::write(format!("{}/report.json", args[out + 1]), r.to_json()?)?;
    std::fs::write(format!("{}/improved.toml", args[out + 1]), improved_toml(&d, &text))?;
    std::fs::write(format!("{}/report.html", args[out + 1]), page(&d, r, &sources).to_html()?)?;
    println!("{:7.2} written", talk.0.elapsed().as_secs_f64());
    Ok(())
}
