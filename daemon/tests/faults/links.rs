//! The error counters of the ports reveal a bad cable before any cycle is lost.

use ballbard::segment::faults::Fault;
use shared::recording::schema::EventKind;

use super::rig::Rig;

#[test]
fn a_noisy_cable_is_reported_with_its_place_while_every_cycle_is_still_valid() {
    let mut rig = Rig::new(5);
    rig.run_to(500);
    assert!(rig.events.is_empty(), "{:?}", rig.events);
    rig.faults.begin(Fault::NoisyCable { position: 3, share: 0.05 });
    rig.run_to(1000);
    rig.assert_true();
    assert!(rig.records.iter().all(|record| record.is_valid()));
    let told = rig.reported_events();
    assert!(told.iter().all(|event| event.kind == EventKind::Bus), "{told:?}");
    // Adjacent terminals are connected by contacts and not by cables, so the text must name a contact.
    assert!(told[0].text.contains("bad contact between terminal 2 and terminal 3"), "{told:?}");
    assert_eq!(told[0].code, "link_errors");
    let errors = rig.acquisition.links().errors()[3][0];
    assert!((15..40).contains(&errors.receive_errors), "{errors:?}");
    // A warning is issued each time the number of errors has doubled, and not at each check.
    assert!((2..=5).contains(&told.len()), "{told:?}");
}

#[test]
fn counters_that_would_stop_are_cleared_and_counted_on() {
    let mut rig = Rig::new(6);
    rig.faults.begin(Fault::NoisyCable { position: 1, share: 1.0 });
    rig.run_to(2000);
    let errors = rig.acquisition.links().errors()[1][0].receive_errors;
    // About 106 frames per second pass the cable, for 20 s.
    assert!((1700..2300).contains(&errors), "{errors}");
}

#[test]
fn a_terminal_that_comes_and_goes_is_a_lost_link_of_the_one_before() {
    let mut rig = Rig::new(7);
    rig.run_to(300);
    rig.faults.begin(Fault::DevicesGone { from: 4 });
    rig.run_to(400);
    rig.faults.end(Fault::DevicesGone { from: 4 });
    rig.run_to(1000);
    assert_eq!(rig.acquisition.links().errors()[3][1].lost_links, 1);
    let told: Vec<_> = rig.reported_events().into_iter().map(|event| event.text).collect();
    assert!(
        told.iter()
            .any(|text| text.contains("between terminal 3 and terminal 4") && text.contains("1 lost links")),
        "{told:?}"
    );
}

#[test]
fn a_terminal_stays_away_when_one_before_it_comes_back() {
    let mut rig = Rig::new(8);
    rig.run_to(300);
    rig.faults.begin(Fault::DevicesGone { from: 5 });
    rig.run_to(320);
    rig.faults.begin(Fault::DevicesGone { from: 3 });
    rig.run_to(340);
    rig.faults.end(Fault::DevicesGone { from: 3 });
    rig.run_to(900);
    assert!(rig.records[400..900].iter().all(|record| !record.is_valid()), "terminal 5 was back");
    rig.faults.end(Fault::DevicesGone { from: 5 });
    rig.run_to(1800);
    assert!(rig.records[1700..].iter().all(|record| record.is_valid()));
    rig.assert_true();
}
