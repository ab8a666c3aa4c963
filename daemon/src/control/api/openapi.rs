//! Generates the OpenAPI document of the API. Bodies and replies are described by their Rust types, so the document always
//! agrees with the code. Each route is added to the router together with its [`Operation`].

use std::collections::BTreeMap;

use axum::http::StatusCode;
use schemars::generate::SchemaSettings;
use schemars::{JsonSchema, Schema, SchemaGenerator};
use serde_json::{Map, Value, json};

use super::remote::COOKIE;
use crate::control::status::Refusal;

/// Location of the schemas in the document.
const SCHEMAS: &str = "/components/schemas";

/// Status codes of refusals, with the reasons.
const REFUSALS: [(StatusCode, &str); 14] = [
    (StatusCode::BAD_REQUEST, "the body is not JSON, or a query parameter is unknown or invalid"),
    (StatusCode::UNAUTHORIZED, "a request from another machine has no valid token"),
    (
        StatusCode::FORBIDDEN,
        "the request has a foreign origin or host, or passed a proxy without --behind-proxy",
    ),
    (StatusCode::NOT_FOUND, "the path, the recording or the run does not exist"),
    (StatusCode::METHOD_NOT_ALLOWED, "the path exists, but not with this method; the reply has no body"),
    (StatusCode::REQUEST_TIMEOUT, "the request did not arrive within 5 seconds"),
    (
        StatusCode::CONFLICT,
        "the state of the service does not permit the request: a run is active, no run is active, or the check found a problem \
         that prevents a run",
    ),
    (StatusCode::PAYLOAD_TOO_LARGE, "the request is longer than 64 kB, or is incomplete"),
    (StatusCode::UNSUPPORTED_MEDIA_TYPE, "the body is not declared as application/json"),
    (StatusCode::UNPROCESSABLE_ENTITY, "a value in the body is invalid, or a field is unknown"),
    (StatusCode::TOO_MANY_REQUESTS, "too many requests with a wrong token in the last minute"),
    (
        StatusCode::INTERNAL_SERVER_ERROR,
        "the disk reports an error, the file of a run could not be finished, or a QR code could not be made",
    ),
    (StatusCode::SERVICE_UNAVAILABLE, "the service is ending, or has too many requests or viewers"),
    (StatusCode::GATEWAY_TIMEOUT, "the disk, the file of a run or the service did not answer in time"),
];

/// One operation of the API.
pub(super) struct Operation {
    /// Path below `/api`.
    pub path: &'static str,
    /// Description in one sentence.
    pub summary: &'static str,
    method: &'static str,
    body: Option<Describe>,
    /// Name and meaning of each query parameter.
    options: &'static [(&'static str, &'static str)],
    answer: ReplyContent,
}

/// Returns the schema of a body or a reply, and adds the schemas that it refers to.
type Describe = fn(&mut SchemaGenerator) -> Schema;

enum ReplyContent {
    Json(Describe),
    /// Another media type, or JSON that is sent piece by piece.
    Other(&'static str),
}

impl Operation {
    /// Describes a GET request whose reply is JSON of type `A`.
    pub fn get<A: JsonSchema>(path: &'static str, summary: &'static str) -> Self {
        let answer = ReplyContent::Json(SchemaGenerator::subschema_for::<A>);
        Self { path, summary, method: "get", body: None, options: &[], answer }
    }

    /// Describes a GET request whose reply has another media type.
    pub fn get_other(path: &'static str, media_type: &'static str, summary: &'static str) -> Self {
        let answer = ReplyContent::Other(media_type);
        Self { path, summary, method: "get", body: None, options: &[], answer }
    }

    /// Adds query parameters. Each is `true` or absent.
    pub fn with_options(self, options: &'static [(&'static str, &'static str)]) -> Self {
        Self { options, ..self }
    }

    /// Describes a POST request with a body of type `B`, whose reply is JSON of type `A`.
    pub fn post<B: JsonSchema, A: JsonSchema>(path: &'static str, summary: &'static str) -> Self {
        let body = Some(SchemaGenerator::subschema_for::<B> as Describe);
        Self { method: "post", body, ..Self::get::<A>(path, summary) }
    }

    /// Describes the operation in the document. The schemas that it refers to are added to the generators.
    fn describe(&self, request_schemas: &mut SchemaGenerator, reply_schemas: &mut SchemaGenerator) -> Value {
        let content = match &self.answer {
            ReplyContent::Json(describe) => json!({"application/json": {"schema": describe(reply_schemas)}}),
            ReplyContent::Other(media_type) => json!({*media_type: {}}),
        };
        let refusal = reply_schemas.subschema_for::<Refusal>();
        let mut described = json!({
            "summary": self.summary,
            "responses": {
                StatusCode::OK.as_str(): {"description": "result", "content": content},
                "default": {
                    "description": "reason of the refusal, and what to do",
                    "content": {"application/json": {"schema": refusal}},
                },
            },
        });
        if let Some(describe) = self.body {
            let schema = describe(request_schemas);
            described["requestBody"] =
                json!({"required": true, "content": {"application/json": {"schema": schema}}});
        }
        let names = self.path.split('/').filter_map(|part| part.strip_prefix('{')?.strip_suffix('}'));
        let parameter =
            |name| json!({"name": name, "in": "path", "required": true, "schema": {"type": "string"}});
        let option = |(name, meaning): &(&str, &str)| {
            let schema = json!({"type": "boolean", "default": false});
            json!({"name": name, "in": "query", "description": meaning, "schema": schema})
        };
        described["parameters"] = names.map(parameter).chain(self.options.iter().map(option)).collect();
        described
    }
}

/// The document, as JSON.
pub(super) fn document(operations: &[Operation]) -> Value {
    let settings =
        |settings: SchemaSettings| settings.with(|settings| settings.definitions_path = SCHEMAS.into());
    // Requests and replies need separate generators: replies contain every field, but requests may omit some fields.
    let mut request_schemas = settings(SchemaSettings::draft2020_12()).for_deserialize().into_generator();
    let mut reply_schemas = settings(SchemaSettings::draft2020_12()).for_serialize().into_generator();
    let mut paths: BTreeMap<String, Map<String, Value>> = BTreeMap::new();
    for operation in operations {
        let described = operation.describe(&mut request_schemas, &mut reply_schemas);
        let of_path = paths.entry(format!("/api{}", operation.path)).or_default();
        of_path.insert(operation.method.into(), described);
    }
    let refused = REFUSALS.map(|(code, reason)| (code.as_str().to_owned(), json!({"description": reason})));
    let mut schemas = request_schemas.take_definitions(true);
    schemas.append(&mut reply_schemas.take_definitions(true));
    json!({
        "openapi": "3.1.0",
        "info": {
            "title": "ballbard",
            "version": env!("CARGO_PKG_VERSION"),
            "description": "The interface of the acquisition service. Programs on the same machine connect to 127.0.0.1 or \
                localhost and need no token. Other machines need the token. They connect over TLS if the service was started \
                with --listen, or through a reverse proxy if it was started with --behind-proxy. The loopback port refuses \
                requests that passed a proxy. All ports refuse requests from web pages of another origin. Requests that change \
                something have a JSON body.",
        },
        "paths": paths,
        // On the machine of the service no token is needed. From other machines one of the other two schemes is needed.
        "security": [{}, {"token": []}, {"browser": []}],
        "components": {
            "schemas": schemas,
            "responses": Map::from_iter(refused),
            "securitySchemes": {
                "token": {
                    "type": "http",
                    "scheme": "bearer",
                    "description": "Content of the file `token` in the service's state directory.",
                },
                "browser": {
                    "type": "apiKey",
                    "in": "cookie",
                    "name": COOKIE,
                    "description": "Cookie with the token. A browser stores it when it opens the page with /?token=TOKEN.",
                },
            },
        },
    })
}
