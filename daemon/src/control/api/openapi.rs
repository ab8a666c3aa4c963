//! The API as an OpenAPI document. What is asked and answered is described by its own types, so that it cannot differ; a
//! route gets into the router together with its [`Operation`] alone.

use std::collections::BTreeMap;

use axum::http::StatusCode;
use schemars::generate::SchemaSettings;
use schemars::{JsonSchema, Schema, SchemaGenerator};
use serde_json::{Map, Value, json};

use super::remote::COOKIE;
use crate::control::status::Refusal;

/// Where schemas are in the document.
const SCHEMAS: &str = "/components/schemas";

/// One thing that can be asked for.
pub(super) struct Operation {
    /// Path below `/api`.
    pub path: &'static str,
    /// In one sentence.
    pub summary: &'static str,
    method: &'static str,
    body: Option<Describe>,
    /// Name and meaning of what the query may set.
    options: &'static [(&'static str, &'static str)],
    answer: Answer,
}

type Describe = fn(&mut SchemaGenerator) -> Schema;

enum Answer {
    Json(Describe),
    /// Of another media type, or JSON that is sent piece by piece.
    Other(&'static str),
}

impl Operation {
    /// Answers with JSON of this type.
    pub fn get<A: JsonSchema>(path: &'static str, summary: &'static str) -> Self {
        let answer = Answer::Json(SchemaGenerator::subschema_for::<A>);
        Self { path, summary, method: "get", body: None, options: &[], answer }
    }

    /// Answers with something else.
    pub fn get_other(path: &'static str, media_type: &'static str, summary: &'static str) -> Self {
        Self { path, summary, method: "get", body: None, options: &[], answer: Answer::Other(media_type) }
    }

    /// May be asked with these in the query, each `true` or left out.
    pub fn with_options(self, options: &'static [(&'static str, &'static str)]) -> Self {
        Self { options, ..self }
    }

    /// Takes and answers JSON of these types.
    pub fn post<B: JsonSchema, A: JsonSchema>(path: &'static str, summary: &'static str) -> Self {
        let body = Some(SchemaGenerator::subschema_for::<B> as Describe);
        Self { method: "post", body, ..Self::get::<A>(path, summary) }
    }
}

/// The document, as JSON.
pub(super) fn document(operations: &[Operation]) -> Value {
    let settings =
        |settings: SchemaSettings| settings.with(|settings| settings.definitions_path = SCHEMAS.into());
    // What is answered has every field, what is asked for may leave some out.
    let mut asked = settings(SchemaSettings::draft2020_12()).for_deserialize().into_generator();
    let mut answered = settings(SchemaSettings::draft2020_12()).for_serialize().into_generator();
    let mut paths: BTreeMap<String, Map<String, Value>> = BTreeMap::new();
    for operation in operations {
        let Operation { path, summary, method, body, options, answer } = operation;
        let content = match answer {
            Answer::Json(describe) => json!({"application/json": {"schema": describe(&mut answered)}}),
            Answer::Other(media_type) => json!({*media_type: {}}),
        };
        let refusal = answered.subschema_for::<Refusal>();
        let mut described = json!({
            "summary": summary,
            "responses": {
                StatusCode::OK.as_str(): {"description": "what was asked for", "content": content},
                "default": {
                    "description": "why not, and what to do",
                    "content": {"application/json": {"schema": refusal}},
                },
            },
        });
        if let Some(describe) = body {
            let schema = describe(&mut asked);
            described["requestBody"] =
                json!({"required": true, "content": {"application/json": {"schema": schema}}});
        }
        let names = path.split('/').filter_map(|part| part.strip_prefix('{')?.strip_suffix('}'));
        let parameter =
            |name| json!({"name": name, "in": "path", "required": true, "schema": {"type": "string"}});
        let option = |(name, meaning): &(&str, &str)| json!({"name": name, "in": "query", "description": meaning, "schema": {"type": "boolean", "default": false}});
        described["parameters"] = names.map(parameter).chain(options.iter().map(option)).collect();
        paths.entry(format!("/api{path}")).or_default().insert((*method).to_owned(), described);
    }
    let mut schemas = asked.take_definitions(true);
    schemas.append(&mut answered.take_definitions(true));
    json!({
        "openapi": "3.1.0",
        "info": {
            "title": "ballbard",
            "version": env!("CARGO_PKG_VERSION"),
            "description": "The acquisition service. Programs of its machine ask 127.0.0.1, under a loopback name, and need no \
                token. Where it was started with --listen others ask over TLS, and where it was started with --behind-proxy \
                over a reverse proxy; both show the token. The loopback address accepts nothing that a proxy passed on. No request comes from a foreign origin; \
                those that change something carry JSON.",
        },
        "paths": paths,
        // None of them, on the service's machine; one of them from elsewhere.
        "security": [{}, {"token": []}, {"browser": []}],
        "components": {
            "schemas": schemas,
            "securitySchemes": {
                "token": {
                    "type": "http",
                    "scheme": "bearer",
                    "description": "What is in the file `token` of the service's state directory.",
                },
                "browser": {
                    "type": "apiKey",
                    "in": "cookie",
                    "name": COOKIE,
                    "description": "The same, as a browser has it that has opened the page with /?token=TOKEN.",
                },
            },
        },
    })
}
