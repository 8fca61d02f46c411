"""Vision-language models behind one small protocol: local Qwen3-VL, or any OpenAI-compatible server."""
