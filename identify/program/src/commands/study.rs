//! `identify study` simulates the experiments of a study that have no stored result, on all processors. Then it writes
//! tables and a page with all results. With `--shard`, it computes and stores only one part of the experiments. `merge`
//! joins the results of all parts.

use std::io::IsTerminal;
use std::num::NonZeroUsize;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::mpsc;
use std::time::Instant;

use clap::{Args, Subcommand};
use shared::output::say;

use super::on_terminal::OnTerminal;
use crate::report::page::StudyPage;
use crate::simulate::Effects;
use crate::study::{self, Definition, Results, Shard, StudySummary, Trial, TrialRows, trials};

/// Number of progress lines in the log of a batch job.
const LINES: usize = 20;

const EXAMPLE: &str = "Example: identify study thesis --figures 3.2 --seeds 3 --out study";

/// Text for `--help` about the conditions that `[[figures]]` may vary.
fn conditions() -> String {
    let mut text = format!("{EXAMPLE}\n\nConditions that `vary` and `with` of a study's file may set:\n");
    for (key, meaning) in study::CONDITIONS {
        text += &format!("  {key:<20}{meaning}\n");
    }
    text += &format!(
        "  {}\n  as the options of `identify simulate` with these names\n",
        Effects::keys().join(", ")
    );
    text + "  rd3, bd1, rbeta2, ..  additional error of this parameter [mm, or mrad for angles]"
}

#[derive(Debug, Args)]
#[command(args_conflicts_with_subcommands = true, subcommand_negates_reqs = true, after_help = EXAMPLE, after_long_help = conditions())]
pub struct StudyArguments {
    /// File of the study, such as config/studies/thesis.toml, or `thesis` for the shipped study, which
    /// repeats the simulations of the thesis
    #[arg(value_name = "STUDY", required = true)]
    study: Option<String>,
    /// Directory for trials.jsonl, points.csv, points.parquet, summary.json and study.html; existing results of the same
    /// study are not computed again
    #[arg(long, help_heading = "Output", value_name = "DIR", required = true)]
    out: Option<PathBuf>,
    /// Number of experiments for each point of a figure; default: `seeds` of the study's file
    #[arg(long, help_heading = "Simulation", value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    seeds: Option<u32>,
    /// Numbers of the figures to compute; default: all
    #[arg(long, help_heading = "Simulation", value_name = "NUMBER", num_args = 1..)]
    figures: Vec<String>,
    /// Compute only part K of N, such as 3/16, so that N machines can divide the work; `identify study merge` joins the parts
    #[arg(long, help_heading = "Simulation", value_name = "K/N")]
    shard: Option<Shard>,
    /// Number of experiments that run at the same time; default: one for each processor. The results do not depend on it
    #[arg(long, help_heading = "Simulation", value_name = "N")]
    threads: Option<NonZeroUsize>,
    #[command(subcommand)]
    command: Option<StudyCommand>,
}

#[derive(Debug, Subcommand)]
enum StudyCommand {
    /// Join the results of all shards of a study.
    #[command(after_help = "Example: identify study merge shard-1 shard-2 --out merged")]
    Merge(MergeArguments),
}

#[derive(Debug, Args)]
struct MergeArguments {
    /// Result directories of all shards
    #[arg(value_name = "SHARD", required = true)]
    shards: Vec<PathBuf>,
    /// Directory for the merged results
    #[arg(long, help_heading = "Output", value_name = "DIR")]
    out: PathBuf,
}

pub fn run(arguments: &StudyArguments) -> anyhow::Result<()> {
    if let Some(StudyCommand::Merge(merge)) = &arguments.command {
        let (definition, results) = study::merge(&merge.shards, &merge.out)?;
        return conclude(&merge.out, &definition, &results);
    }
    let (Some(study), Some(out)) = (&arguments.study, &arguments.out) else {
        anyhow::bail!("name a study and --out");
    };
    let mut definition = Definition::load(study)?;
    if let Some(seeds) = arguments.seeds {
        definition.study.seeds = seeds;
    }
    definition.study.keep_figures(&arguments.figures)?;
    let shard = arguments.shard.unwrap_or(Shard::WHOLE);
    let mut results = Results::open(out, &definition)?;
    let missing: Vec<Trial<'_>> = trials(&definition)
        .filter(|trial| shard.has(trial.number) && !results.done().contains_key(&trial.number))
        .collect();
    compute(&definition, &missing, arguments.threads, &mut results)?;
    if arguments.shard.is_some() {
        ensure_one_succeeded(&results)?;
        say(format_args!("{}; put all shards together with `identify study merge`", out.display()))?;
        return Ok(());
    }
    conclude(out, &definition, &results)
}

/// Runs the missing experiments on all processors and stores each result.
fn compute(
    definition: &Definition,
    missing: &[Trial<'_>],
    threads: Option<NonZeroUsize>,
    results: &mut Results,
) -> anyhow::Result<()> {
    let processors = std::thread::available_parallelism().ok();
    let threads = threads.or(processors).map_or(1, NonZeroUsize::get).min(missing.len().max(1));
    let on_terminal = OnTerminal::new();
    // The progress bar is visible on a terminal only. The log of a batch job contains lines instead.
    let (is_watched, begun) = (std::io::stderr().is_terminal(), Instant::now());
    let (next, stop) = (AtomicUsize::new(0), AtomicBool::new(false));
    let (sender, receiver) = mpsc::channel::<TrialRows>();
    std::thread::scope(|scope| -> anyhow::Result<()> {
        // Each thread runs the next experiment and sends its result, until no experiment is left.
        for _ in 0..threads {
            let (sender, next, stop) = (sender.clone(), &next, &stop);
            scope.spawn(move || {
                while !stop.load(Ordering::Relaxed) {
                    let Some(trial) = missing.get(next.fetch_add(1, Ordering::Relaxed)) else { return };
                    if sender.send(study::run(definition, trial)).is_err() {
                        return;
                    }
                }
            });
        }
        drop(sender);
        // The results are stored in this thread, which also shows the progress.
        let mut done = 0;
        for rows in receiver {
            done += 1;
            let stored = results.add(rows);
            let goes_on = on_terminal.show_count(done, missing.len(), "experiments");
            if !is_watched && done * LINES / missing.len() > (done - 1) * LINES / missing.len() {
                let left_s = begun.elapsed().as_secs_f64() / done as f64 * (missing.len() - done) as f64;
                tracing::info!("{done} of {} experiments, about {left_s:.0} s left", missing.len());
            }
            if stored.is_err() || !goes_on {
                stop.store(true, Ordering::Relaxed);
            }
            stored?;
        }
        let left = missing.len() - done;
        anyhow::ensure!(left == 0, "stopped with {left} experiments to go; repeat the command to continue");
        Ok(())
    })
}

/// Sorts the results and writes tables, figures and answers.
fn conclude(out: &Path, definition: &Definition, results: &Results) -> anyhow::Result<()> {
    results.require(trials(definition).count())?;
    results.put_in_order()?;
    let summary = StudySummary::new(definition, results);
    let mut files =
        vec![study::write_csv(out, definition, results)?, study::write_parquet(out, definition, results)?];
    files.extend(StudyPage { definition, summary: &summary }.write(out)?);
    for finding in &summary.findings {
        let holds = match finding.holds {
            Some(true) => "holds: ",
            Some(false) => "DOES NOT HOLD: ",
            None => "",
        };
        say(format_args!("{holds}{}: {}", finding.text, finding.answer))?;
    }
    let failed: usize = summary.failures.values().sum();
    if failed > 0 {
        say(format_args!("{failed} estimates failed; study.html says why"))?;
    }
    for file in files {
        say(file.display())?;
    }
    ensure_one_succeeded(results)
}

/// Returns an error if every estimate failed.
fn ensure_one_succeeded(results: &Results) -> anyhow::Result<()> {
    let rows = || results.done().values().flat_map(|trial| &trial.rows);
    let reason = rows().next().and_then(|row| row.failed.as_deref());
    if let Some(reason) = reason.filter(|_| rows().all(|row| row.failed.is_some())) {
        anyhow::bail!("all {} estimates failed, the first: {reason}", rows().count());
    }
    Ok(())
}
