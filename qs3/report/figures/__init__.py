"""Pictures of data: contact sheets, class balance, an object through the pipeline."""
