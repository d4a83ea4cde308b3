"""What readers of formats share: records, stamps, columns, tables in text, poses, GNSS solutions."""
