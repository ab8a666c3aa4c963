//! Generates `commands.md`, and checks that the help of every command is complete.

use std::ffi::OsString;

use clap::{CommandFactory, Parser};
use generate::page::{HEADINGS, arguments, commands, example, name, page};

use super::check;

type Ballbard = ballbard::commands::Arguments;
type Identify = identify::commands::IdentifyArguments;

#[test]
fn the_page_on_commands_is_that_of_the_programs() {
    let content = page(Ballbard::command()) + &page(Identify::command());
    check("commands.md", "Commands", "the help of both programs", &content);
}

/// Checks the help of a program and of all its commands.
fn check_help(mut program: clap::Command, parse: impl Fn(Vec<String>) -> Result<(), clap::Error>) {
    program.build();
    for command in commands(&program) {
        let name = name(command);
        let example = example(command).unwrap_or_else(|| panic!("{name}: no line `Example: ` in after_help"));
        // If the command is hidden, users may leave out its name.
        let begin = if command.is_hide_set() { name.rsplit_once(' ').unwrap().0 } else { name };
        assert!(example.starts_with(begin), "{name}: {example}");
        let words = crate::documents::commands(&example).remove(0);
        parse(words).unwrap_or_else(|error| panic!("{example}: {error}"));
        for argument in arguments(command) {
            let (id, heading) = (argument.get_id(), argument.get_help_heading());
            assert!(argument.get_help().is_some(), "{name}: {id} has no text");
            let is_known = heading.map_or(argument.is_positional(), |heading| HEADINGS.contains(&heading));
            assert!(is_known, "{name}: --{id} needs one of the headings {HEADINGS:?}, not {heading:?}");
            // Shell names need no help text.
            for value in argument.get_possible_values().iter().filter(|_| id != "shell") {
                assert!(value.get_help().is_some(), "{name}: {id} {} has no text", value.get_name());
            }
        }
    }
}

#[test]
fn every_command_has_an_example_that_parses_options_with_a_heading_and_values_with_a_text() {
    check_help(Ballbard::command(), |words| Ballbard::try_parse_from(words).map(drop));
    check_help(Identify::command(), |words| {
        Identify::from_words(words.into_iter().map(OsString::from)).map(drop)
    });
}
