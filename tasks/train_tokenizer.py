"""`train_tokenizer`: fit the small video tokenizer of the embedded default."""

from tasks.artifact_task import artifact_task

train_tokenizer = artifact_task("train_tokenizer")

if __name__ == "__main__":
    train_tokenizer.main()
