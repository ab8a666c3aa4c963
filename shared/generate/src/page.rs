//! Writes the commands of a program as a page of Markdown, from the command tree that also produces their help.

use std::fmt::Write;
use std::iter;

use clap::{Arg, Command};

/// Headings that group the options in `--help`. Both programs use the same headings.
pub const HEADINGS: [&str; 7] =
    ["Connection", "Input", "Recording", "Estimation", "Planning", "Simulation", "Output"];

/// Beginning of the line with the example in a command's help.
pub(crate) const EXAMPLE: &str = "Example: ";

/// The program and all its commands, each after the command that contains it. The command `help` is omitted.
pub fn commands(command: &Command) -> Vec<&Command> {
    let below = command.get_subcommands().filter(|below| below.get_name() != "help");
    iter::once(command).chain(below.flat_map(commands)).collect()
}

/// The words that call a command, such as `identify robot check`. [`Command::build`] of the program
/// must have been called before.
pub fn name(command: &Command) -> &str {
    command.get_bin_name().unwrap_or_else(|| command.get_name())
}

/// The example in the help of a command, without its prefix.
pub fn example(command: &Command) -> Option<String> {
    let help = end_of_help(command);
    help.lines().find_map(|line| line.strip_prefix(EXAMPLE)).map(str::to_owned)
}

/// Options and positional arguments of a command. `--help` and `--version` are omitted.
pub fn arguments(command: &Command) -> impl Iterator<Item = &Arg> {
    command.get_arguments().filter(|argument| !["help", "version"].contains(&argument.get_id().as_str()))
}

/// The page: usage, example and options of a program and of all its commands.
pub fn page(mut program: Command) -> String {
    program.build();
    commands(&program).into_iter().map(section).collect()
}

/// The text that follows the options in `--help`; empty if there is none.
fn end_of_help(command: &Command) -> String {
    let text = command.get_after_long_help().or_else(|| command.get_after_help());
    text.map(ToString::to_string).unwrap_or_default()
}

/// The section of one command: heading, description, usage with the example, a table of arguments for each heading of
/// options, and the remaining text after the help.
fn section(command: &Command) -> String {
    let name = name(command);
    let about = command.get_long_about().or_else(|| command.get_about());
    let about = cell(&about.map(ToString::to_string).unwrap_or_default());
    let usage = command.clone().render_usage();
    let mut text =
        format!("{} {name}\n\n{about}\n\n```text\n{usage}\n", "#".repeat(1 + name.split(' ').count()));
    let mut rest = String::new();
    for line in end_of_help(command).lines() {
        match line.strip_prefix(EXAMPLE) {
            Some(example) => text += &format!("Example: {example}\n"),
            None => rest += &format!("{line}\n"),
        }
    }
    text += "```\n";
    for heading in iter::once(None).chain(HEADINGS.map(Some)) {
        let mut under =
            arguments(command).filter(|argument| argument.get_help_heading() == heading).peekable();
        if under.peek().is_some() {
            let title = heading.unwrap_or("Argument");
            let _ = writeln!(text, "\n| {title} | default | meaning |\n|---|---|---|");
            under.for_each(|argument| text += &row(argument));
        }
    }
    if !rest.trim().is_empty() {
        let _ = writeln!(text, "\n```text\n{}\n```", rest.trim());
    }
    text + "\n"
}

/// A row of the table of arguments: argument, default, and meaning with the possible values.
fn row(argument: &Arg) -> String {
    let has_value = argument.get_action().takes_values() && !argument.is_hide_default_value_set();
    let values = argument.get_default_values().iter().map(|value| value.to_string_lossy());
    let default = values.filter(|_| has_value).collect::<Vec<_>>().join(",");
    let default = match default.is_empty() {
        true if argument.is_required_set() => "required".to_owned(),
        true => default,
        false => format!("`{default}`"),
    };
    let help = argument.get_long_help().or_else(|| argument.get_help());
    let mut meaning = cell(&help.map(ToString::to_string).unwrap_or_default());
    for value in argument.get_possible_values() {
        let help = value.get_help().map(|help| format!(": {}", cell(&help.to_string())));
        let _ = write!(meaning, "<br>`{}`{}", value.get_name(), help.unwrap_or_default());
    }
    format!("| `{}` | {default} | {meaning} |\n", argument.to_string().replace('|', "\\|"))
}

/// Converts a text to the content of a table cell: on one line, with `|` escaped, and outside of code with `<` as an entity.
pub fn cell(text: &str) -> String {
    let parts = text.split('`').enumerate();
    let escaped = parts.map(|(n, part)| if n % 2 == 0 { part.replace('<', "&lt;") } else { part.to_owned() });
    escaped.collect::<Vec<_>>().join("`").replace('|', "\\|").replace('\n', " ")
}
