//! Runs of many cycles with random faults.

use ballbard::segment::faults::Fault;
use rand::{Rng, SeedableRng, rngs::StdRng};
use shared::recording::schema::flags;

use super::rig::Rig;

const CYCLES: usize = 100_000;

fn any_fault(random: &mut StdRng) -> Fault {
    let share = random.random_range(0.01..1.0);
    let position = random.random_range(1..=5);
    match random.random_range(0..12) {
        0 => Fault::FrameLost { share },
        1 => Fault::FrameLate { share, by_ns: random.random_range(0..40_000_000) },
        2 => Fault::FrameDuplicated { share },
        3 => Fault::FrameCorrupted { share },
        4 => Fault::WorkingCounterShort { share, by: random.random_range(1..=15) },
        5 => Fault::DevicesGone { from: random.random_range(0..=5) },
        6 => Fault::FallToSafeOp { position, code: random.random() },
        7 => Fault::MailboxAbort { position, code: random.random() },
        8 => Fault::MailboxSilent { position },
        9 => Fault::MailboxEmergency { position, code: random.random() },
        10 => Fault::LinkDown,
        _ => Fault::ClockStep { by_ns: random.random_range(-2_000_000_000..2_000_000_000) },
    }
}

/// Runs `cycles` cycles. In a loop, starts up to three random faults at once, ends them, and
/// then runs cycles without faults.
fn play(mut rig: Rig, seed: u64, cycles: usize) -> Rig {
    let mut random = StdRng::seed_from_u64(seed);
    while rig.records.len() < cycles {
        let quiet = random.random_range(1..600);
        rig.run_to((rig.records.len() + quiet).min(cycles));
        let faults: Vec<Fault> = (0..random.random_range(1..4)).map(|_| any_fault(&mut random)).collect();
        faults.iter().for_each(|fault| rig.faults.begin(*fault));
        let lasts = random.random_range(1..150);
        rig.run_to((rig.records.len() + lasts).min(cycles));
        faults.iter().for_each(|fault| rig.faults.end(*fault));
    }
    rig
}

/// Compares each record with the true counts of the encoders. Returns the number of valid records.
fn judge(rig: &Rig) -> usize {
    rig.assert_complete();
    for record in &rig.records {
        assert!(record.is_valid() || record.flags != 0, "cycle {} is bad without a reason", record.cycle);
    }
    rig.assert_true()
}

#[test]
fn of_100_000_cycles_under_random_faults_every_one_is_there_and_every_valid_one_is_true() {
    let rig = play(Rig::new(3), 20_261_121, CYCLES);
    let valid = judge(&rig);
    let count = |flag: u32| rig.records.iter().filter(|record| record.flags & flag != 0).count();
    println!("{} cycles, {valid} valid, {} events", rig.records.len(), rig.events.len());
    for (flag, name) in flags::NAMES {
        println!("{name:16} {:6}", count(flag));
    }
    assert!(valid > CYCLES / 3, "{valid}");
    assert!(rig.records.last().unwrap().origin > 10 && count(flags::BUS_DOWN) > 1000);
}

#[test]
fn so_it_is_for_other_seeds_at_1_khz_and_without_distributed_clocks() {
    for seed in 0..8 {
        for (period_ns, distributed_clocks) in [(10_000_000, true), (1_000_000, true), (10_000_000, false)] {
            let rig = play(Rig::with(seed, period_ns, distributed_clocks), seed, 8_000);
            let valid = judge(&rig);
            println!("seed {seed}, {period_ns} ns, clocks {distributed_clocks}: {valid} of 8000 valid");
            assert!(valid > 800);
        }
    }
}
