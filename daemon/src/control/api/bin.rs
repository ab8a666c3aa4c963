//! Routes of the bin: list the deleted recordings, move a recording into the bin, restore one, and empty the bin.

use axum::Json;
use axum::extract::{self, State};
use axum::http::StatusCode;
use axum::response::Response;
use shared::recording::Disk;

use super::{JsonBody, find_run, on_disk, refusal, reply};
use crate::control::recordings::bin;
use crate::control::recordings::runs::RunLine;
use crate::control::service::Service;
use crate::control::status::{DeleteRequest, EmptyBinRequest, Granted, Reply};

pub(super) async fn list(State(service): State<Service>) -> Result<Json<Vec<RunLine>>, Response> {
    let directories = service.settings().daemon.directories();
    on_disk(&service, move |disk| bin::list(disk, &directories)).await.map(Json)
}

pub(super) async fn delete(
    State(service): State<Service>,
    JsonBody(DeleteRequest { name }): JsonBody<DeleteRequest>,
) -> Result<Response, Response> {
    let (file, _) = find_run(&service, Ok(extract::Path(name))).await?;
    let put = move |disk: &dyn Disk| {
        let name = bin::put(disk, &file)?;
        tracing::warn!(file = %file.display(), "recording moved into the bin on request");
        Ok(name)
    };
    let name = on_disk(&service, put).await?;
    Ok(reply(&service, Reply { answer: Granted::Deleted, run: Some(name), ..Reply::default() }))
}

pub(super) async fn restore(
    State(service): State<Service>,
    JsonBody(DeleteRequest { name }): JsonBody<DeleteRequest>,
) -> Result<Response, Response> {
    let directories = service.settings().daemon.directories();
    match on_disk(&service, move |disk| bin::restore(disk, &directories, &name)).await? {
        Some(name) => {
            Ok(reply(&service, Reply { answer: Granted::Restored, run: Some(name), ..Reply::default() }))
        }
        None => Err(refusal(
            StatusCode::NOT_FOUND,
            "the bin has no recording of that name; `ballbard bin` lists its content",
        )),
    }
}

pub(super) async fn empty(
    State(service): State<Service>,
    JsonBody(EmptyBinRequest {}): JsonBody<EmptyBinRequest>,
) -> Result<Response, Response> {
    let directories = service.settings().daemon.directories();
    let removed = on_disk(&service, move |disk| bin::empty(disk, &directories)).await?;
    tracing::warn!(removed, "bin emptied on request");
    Ok(reply(&service, Reply { answer: Granted::Emptied, removed: Some(removed), ..Reply::default() }))
}
