"""The contract and the judge: spike streams, cameras, scene folders, metrics, results and the runner."""
