//! Sends the messages of a run to Foxglove, and to other clients of its WebSocket protocol, while the run is recorded.
//! Topics, schemas and times are those of the recording. Clients can only subscribe.
//!
//! The protocol is described in github.com/foxglove/ws-protocol, docs/spec.md (`foxglove.websocket.v1`). The newer
//! `foxglove.sdk.v1` has the same messages.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use axum::body::Bytes;
use axum::extract::State;
use axum::extract::ws::rejection::WebSocketUpgradeRejection;
use axum::extract::ws::{self, WebSocket, WebSocketUpgrade};
use axum::http::StatusCode;
use axum::response::Response;
use serde::Deserialize;
use serde_json::{Value, json};
use shared::recording::TOPICS;
use tokio::sync::broadcast::error::RecvError;
use tokio::time::MissedTickBehavior;

use super::{ApiState, refusal};
use crate::control::live_tap::{LiveTap, Message};
use crate::control::service::Service;

/// Path of the WebSocket.
pub(super) const PATH: &str = "/foxglove";
/// Largest number of connected clients.
pub(super) const CLIENTS_MAX: usize = 8;
const PROTOCOLS: [&str; 2] = ["foxglove.sdk.v1", "foxglove.websocket.v1"];
/// Longest message of a client \[bytes\].
const ASKED_BYTES_MAX: usize = 16 * 1024;
/// Period of the pings that check whether a client is still connected. Between runs nothing else is sent, so a client that
/// vanished would otherwise remain counted as connected.
const PING_PERIOD: Duration = Duration::from_secs(5);
/// Opcode of a message's data.
const MESSAGE_DATA: u8 = 1;
/// Size of opcode, subscription and time before the data \[bytes\].
const HEADER_BYTES: usize = 1 + 4 + 8;

/// Messages of clients. The field "op" of the protocol selects the variant.
#[derive(Debug, Deserialize)]
#[serde(tag = "op", rename_all = "camelCase", rename_all_fields = "camelCase")]
enum ClientMessage {
    Subscribe {
        subscriptions: Vec<Subscription>,
    },
    Unsubscribe {
        subscription_ids: Vec<u32>,
    },
    #[serde(other)]
    Other,
}

#[derive(Debug, Deserialize)]
#[serde(rename_all = "camelCase")]
struct Subscription {
    id: u32,
    channel_id: usize,
}

/// Severity of a status message, with the numbers of the protocol.
#[derive(Clone, Copy)]
enum StatusLevel {
    Warning = 1,
    Error = 2,
}

pub(super) async fn connect(
    State(ApiState { service, foxgloves, .. }): State<ApiState>,
    upgrade: Result<WebSocketUpgrade, WebSocketUpgradeRejection>,
) -> Response {
    let Some(tap) = service.settings().live_tap.clone() else {
        return refusal(
            StatusCode::NOT_FOUND,
            "runs are not published here; start the service with --foxglove",
        );
    };
    let upgrade = match upgrade {
        Ok(upgrade) => upgrade.protocols(PROTOCOLS).max_message_size(ASKED_BYTES_MAX),
        Err(rejection) => return refusal(rejection.status(), &rejection.body_text()),
    };
    if upgrade.selected_protocol().is_none() {
        let spoken = PROTOCOLS.join(" or ");
        return refusal(StatusCode::BAD_REQUEST, &format!("no protocol in common; request {spoken}"));
    }
    let Ok(place) = foxgloves.try_acquire_owned() else {
        let error = format!("{CLIENTS_MAX} clients are connected already; close one of them");
        return refusal(StatusCode::SERVICE_UNAVAILABLE, &error);
    };
    upgrade.on_upgrade(async move |socket| {
        // An error of one client affects only its own connection.
        let _ = publish(socket, &tap, &service).await;
        drop(place);
    })
}

/// Sends messages until the client or the service ends. A client that reads too slowly misses messages
/// and receives a warning with their number.
async fn publish(mut socket: WebSocket, tap: &LiveTap, service: &Service) -> Result<(), axum::Error> {
    let mut messages = tap.listen();
    let mut client = FoxgloveClient::default();
    let mut pings = tokio::time::interval(PING_PERIOD);
    pings.set_missed_tick_behavior(MissedTickBehavior::Delay);
    let server_info = json!({"op": "serverInfo", "name": "ballbard", "capabilities": []});
    for greeting in [server_info, advertised()] {
        socket.send(text(&greeting)).await?;
    }
    loop {
        let answer = tokio::select! {
            () = service.ended() => return socket.send(ws::Message::Close(None)).await,
            _ = pings.tick() => Some(ws::Message::Ping(Bytes::new())),
            asked = socket.recv() => match asked {
                None => return Ok(()),
                Some(Ok(ws::Message::Text(asked))) => client.handle(&asked),
                Some(asked) => asked.map(|_| None)?,
            },
            message = messages.recv() => match message {
                Ok(message) => client.data(&message),
                Err(RecvError::Lagged(missed)) => Some(status(
                    StatusLevel::Warning,
                    &format!("{missed} messages were not sent: the client reads too slowly; the recording has them"),
                )),
                Err(RecvError::Closed) => return Ok(()),
            },
        };
        if let Some(answer) = answer {
            socket.send(answer).await?;
        }
    }
}

/// The subscriptions of a client.
#[derive(Debug, Default)]
struct FoxgloveClient {
    /// Subscription numbers, which the client chooses, by channel.
    subscriptions: BTreeMap<usize, u32>,
}

impl FoxgloveClient {
    /// Executes a request of the client. Returns an error message for the client if the request is invalid.
    fn handle(&mut self, asked: &str) -> Option<ws::Message> {
        match serde_json::from_str(asked) {
            Ok(ClientMessage::Subscribe { subscriptions }) => {
                let mut refused = Vec::new();
                for subscription in &subscriptions {
                    if !self.subscribe(subscription) {
                        refused.push(subscription.id.to_string());
                    }
                }
                let problem = format!(
                    "subscription {} is ignored: no such channel, or already subscribed",
                    refused.join(", ")
                );
                (!refused.is_empty()).then(|| status(StatusLevel::Error, &problem))
            }
            Ok(ClientMessage::Unsubscribe { subscription_ids }) => {
                self.subscriptions.retain(|_, id| !subscription_ids.contains(id));
                None
            }
            Ok(ClientMessage::Other) => {
                Some(status(StatusLevel::Error, "clients may subscribe and unsubscribe, nothing else"))
            }
            Err(error) => Some(status(StatusLevel::Error, &format!("invalid request: {error}"))),
        }
    }

    /// Adds a subscription. Returns false if the channel does not exist, or if the channel or the number is in use.
    fn subscribe(&mut self, &Subscription { id, channel_id }: &Subscription) -> bool {
        let is_free = channel_id < TOPICS.len()
            && !self.subscriptions.contains_key(&channel_id)
            && !self.subscriptions.values().any(|taken| *taken == id);
        if is_free {
            self.subscriptions.insert(channel_id, id);
        }
        is_free
    }

    /// Encodes a message for the client; `None` if the client has not subscribed to its channel.
    fn data(&self, message: &Arc<Message>) -> Option<ws::Message> {
        let channel = TOPICS.iter().position(|topic| *topic == message.topic)?;
        let id = self.subscriptions.get(&channel)?;
        let mut bytes = Vec::with_capacity(HEADER_BYTES + message.data.len());
        bytes.push(MESSAGE_DATA);
        bytes.extend(id.to_le_bytes());
        bytes.extend(message.log_time_ns.to_le_bytes());
        bytes.extend(&message.data);
        Some(ws::Message::Binary(bytes.into()))
    }
}

/// The message that announces the topics of a recording as channels. The number of a channel is the index of its topic.
fn advertised() -> Value {
    let channels: Vec<_> = TOPICS
        .iter()
        .enumerate()
        .map(|(id, topic)| {
            json!({
                "id": id,
                "topic": topic.topic,
                "encoding": "cdr",
                "schemaName": topic.schema_name,
                "schema": topic.schema_text,
                "schemaEncoding": "ros2msg",
            })
        })
        .collect();
    json!({"op": "advertise", "channels": channels})
}

fn status(level: StatusLevel, message: &str) -> ws::Message {
    text(&json!({"op": "status", "level": level as u8, "message": message}))
}

fn text(value: &Value) -> ws::Message {
    ws::Message::Text(value.to_string().into())
}
