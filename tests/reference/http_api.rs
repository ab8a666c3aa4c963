//! Generates `http-api.md` from the OpenAPI document of the service.

use std::fmt::Write;

use generate::page::cell;
use serde_json::Value;

use super::check;

/// A text of the OpenAPI document, formatted as the content of a table cell.
fn text(value: &Value) -> String {
    cell(value.as_str().unwrap_or_default())
}

/// Members of an object. If the value has any other type, the result is empty.
fn members(value: &Value) -> impl Iterator<Item = (&String, &Value)> {
    value.as_object().into_iter().flatten()
}

/// Elements of a list. If the value has any other type, the result is empty.
fn elements(value: &Value) -> impl Iterator<Item = &Value> {
    value.as_array().into_iter().flatten()
}

/// Describes a JSON schema in words. Named schemas become links.
fn kind(schema: &Value) -> String {
    let any = |list: &Value| elements(list).map(kind).collect::<Vec<_>>().join(" or ");
    if let Some(name) = schema["$ref"].as_str().and_then(|path| path.rsplit('/').next()) {
        return format!("[{name}](#{})", name.to_lowercase());
    }
    match &schema["type"] {
        Value::String(list) if list == "array" => format!("list of {}", kind(&schema["items"])),
        Value::String(map) if map == "object" && schema["additionalProperties"].is_object() => {
            format!("object of {}", kind(&schema["additionalProperties"]))
        }
        Value::String(plain) => plain.clone(),
        Value::Array(_) => elements(&schema["type"]).map(text).collect::<Vec<_>>().join(" or "),
        _ => any(if schema["anyOf"].is_array() { &schema["anyOf"] } else { &schema["allOf"] }),
    }
}

fn schema(name: &str, schema: &Value) -> String {
    let mut page = format!("\n### {name}\n\n{}\n", text(&schema["description"]));
    let names = elements(&schema["enum"]).map(|value| (text(value), String::new()));
    let described = elements(&schema["oneOf"]).flat_map(|one| {
        let names: Vec<_> = elements(&one["enum"]).chain(one.get("const")).map(text).collect();
        names.into_iter().map(|name| (name, text(&one["description"])))
    });
    let values: Vec<_> = names.chain(described).collect();
    if !values.is_empty() {
        page += "\n| value | meaning |\n|---|---|\n";
        values.iter().for_each(|(value, meaning)| page += &format!("| `{value}` | {meaning} |\n"));
    }
    let required: Vec<&Value> = elements(&schema["required"]).collect();
    if members(&schema["properties"]).next().is_some() {
        page += "\n| field | type | required | meaning |\n|---|---|---|---|\n";
    }
    for (field, of_field) in members(&schema["properties"]) {
        let is_required = if required.iter().any(|name| *name == field) { "yes" } else { "no" };
        let meaning = text(&of_field["description"]);
        let _ = writeln!(page, "| `{field}` | {} | {is_required} | {meaning} |", kind(of_field));
    }
    page
}

#[test]
fn the_page_on_the_http_interface_is_the_openapi_document() {
    let document = ballbard::control::api::document();
    let mut page = format!("{}\n\n", text(&document["info"]["description"]));
    page += "`GET /api/openapi.json` returns the OpenAPI document.\n\n## Operations\n\n";
    page += "| request | meaning | body | reply |\n|---|---|---|---|\n";
    for (path, methods) in members(&document["paths"]) {
        for (method, operation) in members(methods) {
            let mut meaning = text(&operation["summary"]);
            for option in elements(&operation["parameters"]).filter(|one| one["in"] == "query") {
                let (name, about) = (text(&option["name"]), text(&option["description"]));
                let _ = write!(meaning, "<br>`?{name}={}`: {about}", kind(&option["schema"]));
            }
            let body = kind(&operation["requestBody"]["content"]["application/json"]["schema"]);
            let reply = members(&operation["responses"]["200"]["content"])
                .map(|(media, content)| content.get("schema").map_or_else(|| media.clone(), kind));
            let (method, reply) = (method.to_uppercase(), reply.collect::<Vec<_>>().join(", "));
            let _ = writeln!(page, "| {method} `{path}` | {meaning} | {body} | {reply} |");
        }
    }
    page += "\n## Refusals\n\nThe reply to a refused request has one of these status codes, and a [Refusal](#refusal) as body.\n\n\
        | code | reason |\n|---|---|\n";
    for (code, response) in members(&document["components"]["responses"]) {
        let _ = writeln!(page, "| {code} | {} |", text(&response["description"]));
    }
    page += "\n## Access\n\n| scheme | meaning |\n|---|---|\n";
    for (name, scheme) in members(&document["components"]["securitySchemes"]) {
        let _ = writeln!(page, "| {name} | {} |", text(&scheme["description"]));
    }
    page += "\n## Bodies and replies\n";
    members(&document["components"]["schemas"]).for_each(|(name, of)| page += &schema(name, of));
    check("http-api.md", "HTTP interface", "the OpenAPI document of `ballbard run`", &page);
}
